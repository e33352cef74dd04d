//! Writes down what the machine wants kept over the coordinator's death, beside the owner, which never waits for the disk.
//!
//! One transaction for all that has gathered meanwhile. What does not fit the queue, or the disk does not take, is lost with
//! the process: it is worth a few jobs in the wrong place, not a farm that stands still.

use std::sync::Weak;

use farm_core::coordinator::durable::Keep;
use tokio::sync::mpsc;

use crate::store::Store;

/// Changes that wait for the disk; one that finds the queue full is dropped, and said so in the log.
const QUEUED_CHANGES: usize = 1_024;
/// Changes of one transaction.
const BATCH_CHANGES: usize = 256;

/// The owner's end.
#[derive(Debug)]
pub(crate) struct Keeper(Option<mpsc::Sender<Keep>>);

impl Keeper {
    /// Of a coordinator without a state directory.
    pub(crate) const fn none() -> Self {
        Self(None)
    }

    /// The owner's end, and what writes until that is dropped. The store is locked by who owns it, not by this.
    pub(crate) fn new(store: Weak<Store>) -> (Self, impl Future<Output = ()> + Send) {
        let (changes, queue) = mpsc::channel(QUEUED_CHANGES);
        (Self(Some(changes)), write(store, queue))
    }

    pub(crate) fn keep(&self, change: Keep) {
        let Some(changes) = &self.0 else { return };
        if changes.try_send(change).is_err() {
            tracing::warn!("the disk is slow: a change is not kept");
        }
    }
}

async fn write(store: Weak<Store>, mut queue: mpsc::Receiver<Keep>) {
    let mut batch = Vec::new();
    while queue.recv_many(&mut batch, BATCH_CHANGES).await > 0 {
        let changes = std::mem::take(&mut batch);
        let Some(store) = store.upgrade() else { return };
        match tokio::task::spawn_blocking(move || store.keep(changes)).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::error!(%error, "changes are not kept"),
            Err(error) => tracing::error!(%error, "changes are not kept"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use farm_core::{coordinator::durable::Stopped, id::AppId};

    use super::*;

    #[tokio::test]
    async fn what_was_said_before_the_end_is_on_disk_and_the_directory_is_free() {
        let directory = tempfile::tempdir().unwrap();
        let store = Arc::new(Store::open(directory.path()).unwrap());
        let (keeper, writes) = Keeper::new(Arc::downgrade(&store));
        for app in 1..=600 {
            let stopped = Stopped { app: AppId(app), left_ms: 60_000, reason: "it crashes".to_owned() };
            keeper.keep(Keep::Stopped(stopped));
        }
        drop(keeper);
        writes.await;
        drop(store);
        let restored = Store::open(directory.path()).unwrap().restore().unwrap();
        let apps: Vec<u64> = restored.stopped.iter().map(|stopped| stopped.app.0).collect();
        assert_eq!(apps, (1..=600).collect::<Vec<_>>());
        assert!(restored.stopped.iter().all(|stopped| (1..=60_000).contains(&stopped.left_ms)));
    }
}
