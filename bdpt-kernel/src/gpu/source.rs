//! The module's text: one file per stage, composed at compile time, with a map from offsets back to files.

/// A file of a composed text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SourceFile {
    /// Path under `src/`.
    pub path: &'static str,
    /// Its bytes.
    pub text: &'static str,
}

/// A composed module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ModuleSource {
    /// All files in order: one self-contained WGSL text.
    pub text: &'static str,
    /// The files.
    pub files: &'static [SourceFile],
}

impl ModuleSource {
    /// File, line and column (from 1) of a byte offset in the text; what a WGSL compiler's error names.
    #[must_use]
    pub fn locate(&self, offset: usize) -> Option<(&'static str, usize, usize)> {
        let mut start = 0;
        for file in self.files {
            if offset < start + file.text.len() {
                let before = file.text.get(..offset - start)?;
                let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
                return Some((file.path, before.matches('\n').count() + 1, before.len() - line_start + 1));
            }
            start += file.text.len();
        }
        None
    }
}

/// Composes files under `src/` into one [`ModuleSource`] at compile time.
macro_rules! wgsl {
    ($($path:literal),+ $(,)?) => {
        ModuleSource {
            text: concat!($(include_str!(concat!("../", $path))),+),
            files: &[$(SourceFile { path: $path, text: include_str!(concat!("../", $path)) }),+],
        }
    };
}

static MODULE: ModuleSource = wgsl!(
    "shaders/shared/layout.wgsl",
    "shaders/shared/math.wgsl",
    "shaders/shared/rng.wgsl",
    "shaders/shared/traverse.wgsl",
    "shaders/shared/surface.wgsl",
    "shaders/shared/bsdf.wgsl",
    "shaders/shared/lights.wgsl",
    "shaders/shared/camera.wgsl",
    "shaders/shared/mis.wgsl",
    "shaders/shared/walk.wgsl",
    "shaders/eye.wgsl",
    "shaders/light.wgsl",
    "shaders/first_hit.wgsl",
    "shaders/resolve.wgsl",
);

/// The renderer's module with its map of files.
#[must_use]
pub fn module() -> &'static ModuleSource {
    &MODULE
}

/// The renderer's module: the WGSL text that jobs name.
#[must_use]
pub fn module_source() -> &'static str {
    MODULE.text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_map_back_to_files_and_lines() {
        let source = module();
        assert_eq!(source.text.len(), source.files.iter().map(|f| f.text.len()).sum::<usize>());
        let offset = source.text.find("fn eye(").expect("the eye kernel is part of the module");
        let (path, line, column) = source.locate(offset).expect("an offset inside the text lies in a file");
        assert_eq!(path, "shaders/eye.wgsl");
        let file = source.files.iter().find(|f| f.path == path).expect("the file is listed");
        let text = file.text.lines().nth(line - 1).expect("the line exists");
        assert!(text[column - 1..].starts_with("fn eye("), "{text}");
        assert_eq!(source.locate(source.text.len()), None, "past the end lies no file");
    }
}
