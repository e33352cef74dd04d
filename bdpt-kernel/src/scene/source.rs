//! Text files of a scene: read whole, with a bound, and with places for errors. Never interprets what it reads.

use std::{
    fs, io,
    path::{Component, Path, PathBuf},
};

use super::error::{Place, SceneError};

/// Longest piece of a line that an error repeats, in characters.
const EXCERPT_CHARS: usize = 60;

/// What editors on Windows put before UTF-8 text: no part of it.
const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// A text file in memory.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) path: PathBuf,
    pub(crate) text: String,
}

impl Source {
    /// Reads a file of at most `most_bytes`. A byte order mark is left out. Bytes that are no UTF-8 (names in old encodings) become U+FFFD; control
    /// bytes are refused: such a file is not text.
    pub(crate) fn read(path: &Path, most_bytes: u64) -> Result<Self, SceneError> {
        let failed = |source| SceneError::Read { place: Place { file: path.to_owned(), line: None }, source };
        let metadata = fs::metadata(path).map_err(failed)?;
        if !metadata.is_file() {
            return Err(failed(io::Error::other("not a regular file")));
        }
        if metadata.len() > most_bytes {
            let (file, size_bytes) = (path.to_owned(), metadata.len());
            return Err(SceneError::TooLarge { file, size_bytes, most_bytes });
        }
        let mut bytes = fs::read(path).map_err(failed)?;
        if bytes.starts_with(BYTE_ORDER_MARK) {
            bytes.drain(..BYTE_ORDER_MARK.len());
        }
        if bytes.is_empty() {
            return Err(SceneError::Empty { file: path.to_owned() });
        }
        let control = |byte: &u8| *byte < 0x20 && !matches!(*byte, b'\t' | b'\n' | b'\r' | 0x0c | 0x1a);
        if let Some(at) = bytes.iter().position(control) {
            let line = 1 + bytes[..at].iter().filter(|&&byte| byte == b'\n').count();
            let place = Place { file: path.to_owned(), line: Some(line) };
            return Err(SceneError::NotText { place, byte: bytes[at] });
        }
        let text = String::from_utf8(bytes)
            .unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned());
        Ok(Self { path: path.to_owned(), text })
    }

    /// The place of a line, counted from 1.
    pub(crate) fn line(&self, line: usize) -> Place {
        Place { file: self.path.clone(), line: Some(line) }
    }

    /// The place of a byte offset.
    pub(crate) fn offset(&self, offset: usize) -> Place {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        self.line(1 + before.iter().filter(|&&byte| byte == b'\n').count())
    }

    /// The text of a line, counted from 1, trimmed and shortened.
    pub(crate) fn excerpt_of_line(&self, line: usize) -> String {
        excerpt(self.text.lines().nth(line.saturating_sub(1)).unwrap_or("").trim())
    }

    /// The folder of the file.
    pub(crate) fn folder(&self) -> &Path {
        match self.path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        }
    }
}

/// A name in a scene's files as a path under `folder`; `None` when it is absolute, empty or climbs with `..`.
/// Backslashes count as separators: many files were written on Windows.
pub(crate) fn path_inside(folder: &Path, name: &str) -> Option<PathBuf> {
    let name = name.replace('\\', "/");
    let drive = name.as_bytes().get(1) == Some(&b':');
    let relative = Path::new(&name);
    let plain = relative.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    (!name.is_empty() && !drive && plain).then(|| folder.join(relative))
}

/// The start of a piece of text.
pub(crate) fn excerpt(text: &str) -> String {
    shortened(text, EXCERPT_CHARS)
}

/// The first `most` characters of a text.
pub(crate) fn shortened(text: &str, most: usize) -> String {
    match text.char_indices().nth(most) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_folder() {
        let folder = Path::new("/scenes/a");
        for good in ["a.mtl", "./a.mtl", "sub/a.mtl", "sub\\a.mtl", "a b.mtl", "..a.mtl"] {
            assert!(path_inside(folder, good).is_some_and(|path| path.starts_with(folder)), "{good}");
        }
        for bad in
            ["", "/etc/passwd", "../a.mtl", "sub/../../a.mtl", "..\\a.mtl", "\\\\host\\a", "C:\\a.mtl", "c:a"]
        {
            assert_eq!(path_inside(folder, bad), None, "{bad}");
        }
    }

    #[test]
    fn excerpts_are_short() {
        assert_eq!(shortened("äöü", 3), "äöü");
        assert_eq!(shortened("äöüß", 3), "äöü...");
    }

    #[test]
    fn places_count_lines_from_one() {
        let source = Source { path: "x.toml".into(), text: "a\nbb\nccc".into() };
        for (offset, line) in [(0, 1), (1, 1), (2, 2), (5, 3), (99, 3)] {
            assert_eq!(source.offset(offset).to_string(), format!("x.toml:{line}"), "offset {offset}");
        }
        assert_eq!(source.excerpt_of_line(2), "bb");
        assert_eq!(excerpt(&"ä".repeat(100)).chars().count(), EXCERPT_CHARS + 3);
    }
}
