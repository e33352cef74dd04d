//! Which plug-ins a folder holds.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use farm_core::coordinator::policy::BUILT_IN;

use crate::StartError;

/// Most plug-ins of a folder; one with more is refused.
const MAX_PLUGINS: usize = 64;
/// Longest name, in bytes.
const MAX_NAME_BYTES: usize = 64;

/// Names and resolved paths of the plug-ins: files `NAME.so`. Other files are not looked at.
pub(super) fn scan(folder: &Path) -> Result<BTreeMap<String, PathBuf>, StartError> {
    let fault = |path: &Path, reason: &dyn ToString| StartError::Plugin {
        path: path.to_owned(),
        reason: reason.to_string(),
    };
    let unreadable = |error: io::Error| fault(folder, &error);
    let folder_resolved = folder.canonicalize().map_err(unreadable)?;
    let mut plugins = BTreeMap::new();
    for entry in fs::read_dir(&folder_resolved).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        if path.extension().is_none_or(|extension| extension != "so") {
            continue;
        }
        let name = path.file_stem().and_then(|stem| stem.to_str()).filter(|name| is_name(name));
        let name = name.ok_or_else(|| fault(&path, &"its name is not 1 to 64 of a-z, 0-9, '_', '-'"))?;
        if BUILT_IN.contains(&name) {
            return Err(fault(&path, &"has the name of a built-in policy"));
        }
        let resolved = path.canonicalize().map_err(|error| fault(&path, &error))?;
        if !resolved.starts_with(&folder_resolved) {
            return Err(fault(&path, &format!("leads out of the folder, to {}", resolved.display())));
        }
        if !resolved.is_file() {
            return Err(fault(&path, &"is not a file"));
        }
        plugins.insert(name.to_owned(), resolved);
        if plugins.len() > MAX_PLUGINS {
            return Err(fault(folder, &format!("holds more than {MAX_PLUGINS} plug-ins")));
        }
    }
    Ok(plugins)
}

fn is_name(name: &str) -> bool {
    let allowed = |byte: u8| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-');
    (1..=MAX_NAME_BYTES).contains(&name.len()) && name.bytes().all(allowed)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn names_become_paths_of_the_folder_alone() {
        let folder = tempfile::tempdir().unwrap();
        let outside = tempfile::NamedTempFile::new().unwrap();
        fs::write(folder.path().join("README"), "").unwrap();
        fs::write(folder.path().join("pack.so.1"), "").unwrap();
        symlink("pack.so.1", folder.path().join("pack.so")).unwrap();
        let found = scan(folder.path()).unwrap();
        assert_eq!(found.keys().collect::<Vec<_>>(), ["pack"]);
        assert!(found["pack"].ends_with("pack.so.1"), "resolved: {found:?}");

        let refused = |name: &str, make: &dyn Fn(&Path)| {
            let path = folder.path().join(name);
            make(&path);
            let error = scan(folder.path()).unwrap_err().to_string();
            assert!(error.contains(name), "the error names {name}: {error}");
            fs::remove_file(&path).unwrap();
        };
        let file = |path: &Path| fs::write(path, "").unwrap();
        for name in
            ["fcfs.so", "history.so", "Pack.so", "a b.so", "a.b.so", &format!("{}.so", "a".repeat(65))]
        {
            refused(name, &file);
        }
        refused("away.so", &|path| symlink(outside.path(), path).unwrap());
        refused("dangling.so", &|path| symlink("nothing", path).unwrap());
        assert_eq!(scan(folder.path()).unwrap().len(), 1, "what was wrong is gone");
        assert!(scan(&folder.path().join("none")).unwrap_err().to_string().contains("none"));
    }
}
