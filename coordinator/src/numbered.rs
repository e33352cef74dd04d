//! Files of a directory that differ by a number in their names, such as `leader-7`.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

/// What such names have before and after their numbers.
pub(crate) struct Numbered {
    pub(crate) before: &'static str,
    pub(crate) after: &'static str,
}

impl Numbered {
    fn name(&self, number: u64) -> String {
        format!("{}{number}{}", self.before, self.after)
    }

    /// Where the file of a number is, or would be.
    pub(crate) fn path(&self, directory: &Path, number: u64) -> PathBuf {
        directory.join(self.name(number))
    }

    /// Those that are there, in no order. Another spelling of a number is not ours.
    pub(crate) fn all(&self, directory: &Path) -> io::Result<Vec<u64>> {
        let mut numbers = Vec::new();
        for entry in fs::read_dir(directory)? {
            let name = entry?.file_name();
            let Some(name) = name.to_str() else { continue };
            let digits = name.strip_prefix(self.before).and_then(|rest| rest.strip_suffix(self.after));
            let number: Option<u64> = digits.and_then(|digits| digits.parse().ok());
            numbers.extend(number.filter(|&number| self.name(number) == name));
        }
        Ok(numbers)
    }

    /// The largest; 0: there is none.
    pub(crate) fn latest(&self, directory: &Path) -> io::Result<u64> {
        Ok(self.all(directory)?.into_iter().max().unwrap_or(0))
    }

    /// Removes those before a number; what stays is looked at by nobody.
    pub(crate) fn remove_before(&self, directory: &Path, number: u64) {
        for earlier in self.all(directory).unwrap_or_default() {
            if earlier < number {
                let _ = fs::remove_file(self.path(directory, earlier));
            }
        }
    }
}
