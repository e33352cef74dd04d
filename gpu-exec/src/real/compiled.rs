//! What the driver has compiled, kept on disk for later processes: a file for each kind of adapter, its digest first.
//!
//! Nothing depends on it but time: a file that is not right, not readable or not written costs a compilation.

use std::{
    fs, io,
    path::{Path, PathBuf},
    process,
    time::Duration,
};

use super::{adapter::Gpu, trusted};

/// Most bytes of a file: more is neither read nor written.
const MAX_BYTES: usize = 256 << 20;
const DIGEST_BYTES: usize = blake3::OUT_LEN;
/// A file that was being read or written, this old, is of a process that is gone.
const ABANDONED_AFTER: Duration = Duration::from_secs(3_600);

/// The driver's cache, with its file.
#[derive(Debug)]
pub(super) struct Compiled {
    cache: wgpu::PipelineCache,
    file: PathBuf,
}

impl Compiled {
    /// What is in `folder` for this device; `None` where its driver keeps nothing.
    pub(super) fn open(gpu: &Gpu, folder: &Path) -> Option<Self> {
        let file = folder.join(gpu.compiled_key.as_ref()?);
        let reading = file.with_extension(format!("reading-{}", process::id()));
        remove_abandoned(folder);
        // A driver that does not survive these bytes does not meet them again.
        let moved = fs::rename(&file, &reading);
        let data = moved.and_then(|()| read(&reading));
        let made = gpu.scoped(|| trusted::create_pipeline_cache(&gpu.device, data.as_deref().ok()));
        match &data {
            Ok(_) => {
                // Another process may have written meanwhile: its file is as good, and this one goes.
                let _ = fs::hard_link(&reading, &file);
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => {
                tracing::warn!(file = %file.display(), %error, "compiled kernels are not taken from disk")
            }
        }
        let _ = fs::remove_file(&reading);
        match made {
            Ok(cache) => Some(Self { cache, file }),
            Err(refusal) => {
                tracing::debug!(?refusal, "the driver keeps no compiled kernels");
                None
            }
        }
    }

    pub(super) const fn cache(&self) -> &wgpu::PipelineCache {
        &self.cache
    }

    /// Writes what there is now, after something was compiled.
    pub(super) fn save(&self) {
        let Some(data) = self.cache.get_data().filter(|data| data.len() <= MAX_BYTES) else { return };
        if let Err(error) = write(&self.file, &data) {
            tracing::debug!(file = %self.file.display(), %error, "compiled kernels are not kept on disk");
        }
    }
}

/// Removes what processes that are gone were reading or writing.
fn remove_abandoned(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let unfinished = path
            .extension()
            .and_then(|extension| extension.to_str())
            .is_some_and(|extension| extension.starts_with("reading-") || extension.starts_with("writing-"));
        let changed = entry.metadata().and_then(|metadata| metadata.modified());
        if unfinished && changed.is_ok_and(|at| at.elapsed().is_ok_and(|age| age > ABANDONED_AFTER)) {
            // It will be tried again at the next start.
            let _ = fs::remove_file(path);
        }
    }
}

fn read(file: &Path) -> io::Result<Vec<u8>> {
    let invalid = |reason: &str| io::Error::new(io::ErrorKind::InvalidData, reason.to_owned());
    if fs::metadata(file)?.len() > (MAX_BYTES + DIGEST_BYTES) as u64 {
        return Err(invalid("the file is too large"));
    }
    let mut bytes = fs::read(file)?;
    let data = bytes.split_off(DIGEST_BYTES.min(bytes.len()));
    if bytes != blake3::hash(&data).as_bytes() {
        return Err(invalid("the file is spoilt"));
    }
    Ok(data)
}

/// Whole or not at all.
fn write(file: &Path, data: &[u8]) -> io::Result<()> {
    if let Some(folder) = file.parent() {
        fs::create_dir_all(folder)?;
    }
    let unfinished = file.with_extension(format!("writing-{}", process::id()));
    let bytes = [blake3::hash(data).as_bytes(), data].concat();
    let written = fs::write(&unfinished, bytes).and_then(|()| fs::rename(&unfinished, file));
    if written.is_err() {
        // A full disk must not keep half a file; one that is not there is as good.
        let _ = fs::remove_file(&unfinished);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_come_back_and_spoilt_ones_do_not() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipelines").join("key");
        write(&file, b"compiled").unwrap();
        assert_eq!(read(&file).unwrap(), b"compiled");
        let mut bytes = fs::read(&file).unwrap();
        bytes[DIGEST_BYTES] ^= 1;
        fs::write(&file, &bytes).unwrap();
        assert_eq!(read(&file).unwrap_err().kind(), io::ErrorKind::InvalidData);
        for length in [0, 5, DIGEST_BYTES] {
            fs::write(&file, &bytes[..length]).unwrap();
            assert_eq!(read(&file).unwrap_err().kind(), io::ErrorKind::InvalidData, "{length} B");
        }
        assert_eq!(fs::read_dir(file.parent().unwrap()).unwrap().count(), 1, "nothing unfinished is left");
    }
}
