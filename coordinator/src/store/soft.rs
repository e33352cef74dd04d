//! What the machine learnt and wants back after a restart: stopped applications and devices' speeds.
//!
//! Losing an entry costs little, so one that makes no sense is left out and named in the log; damage to the file is another
//! matter, which opening the store finds.

use std::{
    collections::BTreeMap,
    time::{SystemTime, UNIX_EPOCH},
};

use farm_core::{
    coordinator::durable::{Keep, MAX_KNOWN_NODES, MAX_STOPPED, NodeSpeeds, Restored, Stopped},
    id::AppId,
};
use redb::{ReadableTable as _, ReadableTableMetadata as _, Table, TableDefinition, WriteTransaction};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{Store, StoreError, broken, fault};
use crate::StartError;

/// Stopped applications as JSON, by id.
pub(super) const STOPPED: TableDefinition<'_, u64, &str> = TableDefinition::new("stopped");
/// Devices' speeds as JSON, by the name of their node.
pub(super) const SPEEDS: TableDefinition<'_, &str, &str> = TableDefinition::new("speeds");

/// A stop's end does not depend on when it is read.
#[derive(Serialize, Deserialize)]
struct StoppedUntil {
    /// In milliseconds since 1970.
    until_ms: u64,
    reason: String,
}

/// The speeds of a node, and when they were kept, in milliseconds since 1970.
#[derive(Serialize, Deserialize)]
struct KeptSpeeds {
    kept_ms: u64,
    speeds: NodeSpeeds,
}

impl Store {
    /// Keeps all of it, or nothing.
    pub(crate) fn keep(&self, changes: Vec<Keep>) -> Result<(), StoreError> {
        self.keep_at(changes, now_ms())
    }

    /// What is kept still, for the start.
    pub(crate) fn restore(&self) -> Result<Restored, StartError> {
        self.restored().map_err(|error| fault(&self.path, &error))
    }

    pub(super) fn restored(&self) -> Result<Restored, StoreError> {
        self.restored_at(now_ms())
    }

    fn keep_at(&self, changes: Vec<Keep>, now_ms: u64) -> Result<(), StoreError> {
        // The last word on a node counts.
        let (mut stopped, mut speeds) = (Vec::new(), BTreeMap::new());
        for change in changes {
            match change {
                Keep::Stopped(change) => stopped.push(change),
                Keep::Speeds(change) => drop(speeds.insert(change.node.clone(), change)),
            }
        }
        self.write(|transaction| {
            if !stopped.is_empty() {
                keep_stopped(transaction, stopped, now_ms)?;
            }
            keep_speeds(transaction, speeds, now_ms)
        })
    }

    fn restored_at(&self, now_ms: u64) -> Result<Restored, StoreError> {
        self.read(|transaction| {
            let mut restored = Restored::default();
            for entry in transaction.open_table(STOPPED).map_err(broken)?.iter().map_err(broken)? {
                let (app, text) = entry.map_err(broken)?;
                let Some(StoppedUntil { until_ms, reason }) = read(text.value()) else { continue };
                let left_ms = until_ms.saturating_sub(now_ms);
                if left_ms > 0 {
                    restored.stopped.push(Stopped { app: AppId(app.value()), left_ms, reason });
                }
            }
            let mut kept: Vec<KeptSpeeds> = Vec::new();
            for entry in transaction.open_table(SPEEDS).map_err(broken)?.iter().map_err(broken)? {
                let (_, text) = entry.map_err(broken)?;
                kept.extend(read::<KeptSpeeds>(text.value()));
            }
            kept.sort_by_key(|kept| kept.kept_ms);
            restored.speeds = kept.into_iter().map(|kept| kept.speeds).collect();
            Ok(restored)
        })
    }
}

fn keep_stopped(
    transaction: &WriteTransaction,
    stopped: Vec<Stopped>,
    now_ms: u64,
) -> Result<(), StoreError> {
    let mut table = transaction.open_table(STOPPED).map_err(broken)?;
    table
        .retain(|_, text| read::<StoppedUntil>(text).is_some_and(|stopped| stopped.until_ms > now_ms))
        .map_err(broken)?;
    for Stopped { app, left_ms, reason } in stopped {
        if table.len().map_err(broken)? >= MAX_STOPPED as u64 {
            table.pop_first().map_err(broken)?;
        }
        let text = text_of(&StoppedUntil { until_ms: now_ms.saturating_add(left_ms), reason })?;
        table.insert(app.0, text.as_str()).map_err(broken)?;
    }
    Ok(())
}

fn keep_speeds(
    transaction: &WriteTransaction,
    speeds: BTreeMap<String, NodeSpeeds>,
    now_ms: u64,
) -> Result<(), StoreError> {
    let mut table = transaction.open_table(SPEEDS).map_err(broken)?;
    for (node, speeds) in speeds {
        let is_new = table.get(node.as_str()).map_err(broken)?.is_none();
        if is_new && table.len().map_err(broken)? >= MAX_KNOWN_NODES as u64 {
            forget_oldest(&mut table)?;
        }
        let text = text_of(&KeptSpeeds { kept_ms: now_ms, speeds })?;
        table.insert(node.as_str(), text.as_str()).map_err(broken)?;
    }
    Ok(())
}

fn forget_oldest(table: &mut Table<'_, &str, &str>) -> Result<(), StoreError> {
    let mut oldest: Option<(u64, String)> = None;
    for entry in table.iter().map_err(broken)? {
        let (node, text) = entry.map_err(broken)?;
        // What makes no sense goes first.
        let kept_ms = read::<KeptSpeeds>(text.value()).map_or(0, |kept| kept.kept_ms);
        if oldest.as_ref().is_none_or(|(least_ms, _)| kept_ms < *least_ms) {
            oldest = Some((kept_ms, node.value().to_owned()));
        }
    }
    if let Some((_, node)) = oldest {
        table.remove(node.as_str()).map_err(broken)?;
    }
    Ok(())
}

fn read<T: DeserializeOwned>(text: &str) -> Option<T> {
    serde_json::from_str(text)
        .inspect_err(|error| tracing::warn!(%error, text, "an entry of the control store is left out"))
        .ok()
}

fn text_of(value: &impl Serialize) -> Result<String, StoreError> {
    serde_json::to_string(value).map_err(|error| StoreError::Broken(error.to_string()))
}

fn now_ms() -> u64 {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_1970.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use farm_core::coordinator::durable::DeviceSpeed;

    use super::*;

    const NOW_MS: u64 = 1_000_000;

    fn stopped(app: u64, left_ms: u64) -> Stopped {
        Stopped { app: AppId(app), left_ms, reason: format!("app {app} crashes") }
    }

    fn speeds(node: &str, speed: f64) -> NodeSpeeds {
        let device = DeviceSpeed { name: "gpu".to_owned(), score: 1_000.0, speed: Some(speed) };
        NodeSpeeds { node: node.to_owned(), devices: vec![device] }
    }

    #[test]
    fn what_was_kept_is_there_in_the_next_life() {
        let directory = tempfile::tempdir().unwrap();
        let changes = vec![
            Keep::Speeds(speeds("b", 1.0)),
            Keep::Stopped(stopped(1, 60_000)),
            Keep::Stopped(stopped(2, 10)),
            Keep::Speeds(speeds("b", 2.0)),
        ];
        let store = Store::open(directory.path()).unwrap();
        store.keep_at(changes, NOW_MS).unwrap();
        store.keep_at(vec![Keep::Speeds(speeds("a", 3.0))], NOW_MS + 1).unwrap();
        drop(store);
        let restored = Store::open(directory.path()).unwrap().restored_at(NOW_MS + 1_000).unwrap();
        assert_eq!(restored.stopped, [stopped(1, 59_000)], "the other one's time is over");
        assert_eq!(restored.speeds, [speeds("b", 2.0), speeds("a", 3.0)], "the last ones last");
    }

    #[test]
    fn the_tables_are_bounded_and_the_oldest_go() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        let many = (0..MAX_KNOWN_NODES).map(|node| Keep::Speeds(speeds(&format!("node {node}"), 1.0)));
        store.keep_at(vec![Keep::Speeds(speeds("old", 1.0))], NOW_MS).unwrap();
        store.keep_at(many.collect(), NOW_MS + 1).unwrap();
        let many = (0..=MAX_STOPPED as u64).map(|app| Keep::Stopped(stopped(app, 60_000)));
        store.keep_at(many.collect(), NOW_MS).unwrap();
        let restored = store.restored_at(NOW_MS + 1).unwrap();
        assert_eq!(restored.stopped.len(), MAX_STOPPED);
        assert_eq!(restored.speeds.len(), MAX_KNOWN_NODES);
        assert!(restored.speeds.iter().all(|speeds| speeds.node != "old"), "the oldest one");
    }

    #[test]
    fn an_entry_that_makes_no_sense_is_left_out() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        let garbled = store.write(|transaction| {
            transaction.open_table(SPEEDS).map_err(broken)?.insert("x", "{}").map_err(broken)?;
            transaction.open_table(STOPPED).map_err(broken)?.insert(7, "").map_err(broken)?;
            Ok(())
        });
        garbled.unwrap();
        store.keep_at(vec![Keep::Speeds(speeds("a", 3.0))], NOW_MS).unwrap();
        let restored = store.restored_at(NOW_MS).unwrap();
        assert_eq!((restored.stopped.len(), restored.speeds), (0, vec![speeds("a", 3.0)]));
    }
}
