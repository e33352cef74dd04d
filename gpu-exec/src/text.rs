//! Bounds on the text of a module that naga and a driver's compiler do not have: both recurse over it, on a stack that ends, and
//! a driver copies a function into each of its callers.
//!
//! A module comes from a stranger. One of 400 kB that adds 100,000 ones ends the worker's process; one of 1 kB whose 30
//! functions each call the one before twice takes a driver's compiler hours and all memory. Neither is a kernel of anybody's.

use naga::{Block, Statement};
use thiserror::Error;

/// Most bytes of a module's text.
pub(crate) const MAX_TEXT_BYTES: usize = 1 << 20;
/// Most levels of an expression, type or statement: of brackets, and of operators in a row. In a debug build a device's thread,
/// of 16 MiB, overflows at some 50,000, and one of the usual 2 MiB at an eighth of that.
pub(crate) const MAX_LEVELS: usize = 2_000;
/// Most declarations. naga follows each to those that it uses by recursion: 10,000 functions that call the next one overflow a
/// thread of 2 MiB. Our own kernels are far below.
pub(crate) const MAX_DECLARATIONS: usize = 4_000;
/// Most statements and expressions of an entry point with each function counted once for each call that leads to it. Our own
/// kernels are far below.
pub(crate) const MAX_EXPANDED: u64 = 500_000;
/// Longest message of the parser that is passed on, in bytes: it shows the line at fault, however long that is.
pub(crate) const MAX_MESSAGE_BYTES: usize = 2 << 10;

/// A module's text is refused. Not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub(crate) enum TextError {
    /// Too long.
    #[error("WGSL text of {bytes} B is over {MAX_TEXT_BYTES} B")]
    TooLong {
        /// Its bytes.
        bytes: usize,
    },
    /// No text.
    #[error("no UTF-8 text: {0}")]
    NotText(#[from] std::str::Utf8Error),
    /// A line end or blank of the unusual kind.
    #[error("line {line}: holds {mark:?}; end lines with a line feed, and part words with blanks or tabs")]
    Mark {
        /// Where, from 1.
        line: usize,
        /// Which.
        mark: char,
    },
    /// Brackets in brackets, or operators in a row.
    #[error("line {line}: an expression, type or statement of more than {MAX_LEVELS} levels")]
    TooDeep {
        /// Where it gets too deep, from 1.
        line: usize,
    },
    /// Declarations without end.
    #[error("line {line}: more than {MAX_DECLARATIONS} declarations")]
    TooMany {
        /// Where the first one too many ends, from 1.
        line: usize,
    },
    /// No WGSL.
    #[error("{0}")]
    Parser(String),
    /// Functions that call functions that call...
    #[error("{function}: has more than {MAX_EXPANDED} statements once every call is followed")]
    TooMuch {
        /// The function.
        function: String,
    },
}

/// Reads a module's bytes: text within its bounds, and WGSL that expands to a bounded program. Whether it is valid is the
/// compiler's to say.
///
/// # Errors
/// What is wrong, with the line where there is one.
pub(crate) fn parse(bytes: &[u8]) -> Result<(&str, naga::Module), TextError> {
    if bytes.len() > MAX_TEXT_BYTES {
        return Err(TextError::TooLong { bytes: bytes.len() });
    }
    let text = std::str::from_utf8(bytes)?;
    check_marks(text)?;
    check_levels(text)?;
    let module = naga::front::wgsl::parse_str(text)
        .map_err(|error| TextError::Parser(cut(&error.emit_to_string(text))))?;
    check_expansion(&module)?;
    Ok((text, module))
}

/// The start of a message, without trailing blank lines.
pub(crate) fn cut(message: &str) -> String {
    let message = message.trim_end();
    match message.len() > MAX_MESSAGE_BYTES {
        true => format!("{}...", &message[..message.floor_char_boundary(MAX_MESSAGE_BYTES)]),
        false => message.to_owned(),
    }
}

/// One open bracket.
#[derive(Default)]
struct Level {
    /// Levels of the tree of what was read since the last separator: operators that follow each other nest to the left.
    now: usize,
    /// The most of any piece before.
    most: usize,
}

impl Level {
    fn separate(&mut self) {
        self.most = self.most.max(self.now);
        self.now = 0;
    }

    fn all(&self) -> usize {
        self.most.max(self.now)
    }
}

/// Refuses line ends and blanks that WGSL has and nobody uses: a comment ends at each, and a module could hide from the check
/// below what it shows to the parser.
fn check_marks(text: &str) -> Result<(), TextError> {
    let mut line = 1;
    for mark in text.chars() {
        match mark {
            '\n' => line += 1,
            '\u{b}' | '\u{c}' | '\u{85}' | '\u{200e}' | '\u{200f}' | '\u{2028}' | '\u{2029}' => {
                return Err(TextError::Mark { line, mark });
            }
            _ => {}
        }
    }
    Ok(())
}

/// An upper bound on the levels of the syntax tree, from the text's marks alone: nothing here recurses.
fn check_levels(text: &str) -> Result<(), TextError> {
    let (mut open, mut here, mut line, mut declarations) = (Vec::new(), Level::default(), 1, 0);
    let mut rest = text.as_bytes();
    // A block was closed: its statement ends there, unless an `else` goes on with it.
    let mut closed = false;
    while let [byte, behind @ ..] = rest {
        let comes = rest;
        rest = behind;
        let is_comment = comes.starts_with(b"//") || comes.starts_with(b"/*");
        if closed && !is_comment && !byte.is_ascii_whitespace() {
            closed = false;
            if !comes.starts_with(b"else") {
                here.separate();
            }
        }
        match byte {
            b'\n' => line += 1,
            b'/' if rest.starts_with(b"/") => {
                rest =
                    &rest[rest.iter().position(|byte| matches!(byte, b'\n' | b'\r')).unwrap_or(rest.len())..];
            }
            b'/' if rest.starts_with(b"*") => rest = comment(rest, &mut line),
            b'(' | b'[' | b'{' => open.push(std::mem::take(&mut here)),
            b')' | b']' | b'}' => {
                let inner = here.all() + 1;
                here = open.pop().unwrap_or_default();
                // Calls, elements (`a[0][0]`) and `else` in a row are levels as operators are.
                here.now = here.now.max(inner) + 1;
                closed = *byte == b'}';
            }
            b',' | b';' => here.separate(),
            b'+' | b'-' | b'*' | b'/' | b'%' | b'&' | b'|' | b'^' | b'<' | b'>' | b'!' | b'~' | b'.'
            | b'=' => here.now += 1,
            _ => {}
        }
        declarations += usize::from(open.is_empty() && matches!(byte, b';' | b'}'));
        if declarations > MAX_DECLARATIONS {
            return Err(TextError::TooMany { line });
        }
        if open.len() + here.now > MAX_LEVELS {
            return Err(TextError::TooDeep { line });
        }
    }
    Ok(())
}

/// What follows a block comment, of which one slash is read; they nest.
fn comment<'a>(mut rest: &'a [u8], line: &mut usize) -> &'a [u8] {
    let mut depth = 1_usize;
    rest = &rest[1..];
    while depth > 0 {
        match rest {
            [] => break,
            [b'*', b'/', behind @ ..] => (depth, rest) = (depth - 1, behind),
            [b'/', b'*', behind @ ..] => (depth, rest) = (depth + 1, behind),
            [byte, behind @ ..] => {
                *line += usize::from(*byte == b'\n');
                rest = behind;
            }
        }
    }
    rest
}

/// Follows every call. naga keeps functions behind those that they call.
fn check_expansion(module: &naga::Module) -> Result<(), TextError> {
    let mut sizes: Vec<u64> = Vec::with_capacity(module.functions.len());
    let entries = module.entry_points.iter().map(|entry| &entry.function);
    for function in module.functions.iter().map(|(_, function)| function).chain(entries) {
        let size = expanded(&function.body, &sizes).saturating_add(function.expressions.len() as u64);
        if size > MAX_EXPANDED {
            let function = function.name.as_deref().unwrap_or("a function");
            return Err(TextError::TooMuch { function: cut(function) });
        }
        sizes.push(size);
    }
    Ok(())
}

/// Statements of a block with all within; its depth is bounded by [`MAX_LEVELS`].
fn expanded(block: &Block, sizes: &[u64]) -> u64 {
    let within = |statement: &Statement| match statement {
        Statement::Call { function, .. } => sizes.get(function.index()).copied().unwrap_or(0),
        Statement::Block(block) => expanded(block, sizes),
        Statement::If { accept, reject, .. } => {
            expanded(accept, sizes).saturating_add(expanded(reject, sizes))
        }
        Statement::Switch { cases, .. } => {
            cases.iter().fold(0_u64, |sum, case| sum.saturating_add(expanded(&case.body, sizes)))
        }
        Statement::Loop { body, continuing, .. } => {
            expanded(body, sizes).saturating_add(expanded(continuing, sizes))
        }
        _ => 0,
    };
    block.iter().fold(0_u64, |sum, statement| sum.saturating_add(1).saturating_add(within(statement)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_main(body: &str) -> String {
        format!("@compute @workgroup_size(1) fn main() {{ {body} }}")
    }

    #[test]
    fn what_overflows_a_compilers_stack_is_refused_by_its_line() {
        const MANY: usize = 100_000;
        for (what, text) in [
            ("sums", of_main(&format!("let x = 1{};", " + 1".repeat(MANY)))),
            ("sums of calls", of_main(&format!("let x = f(){};", " + f(1, 2)".repeat(MANY)))),
            ("elements", of_main(&format!("let x = a{};", "[0]".repeat(MANY)))),
            ("members", of_main(&format!("let x = a{};", ".a".repeat(MANY)))),
            ("less than", of_main(&format!("let x = a{};", "<a".repeat(MANY)))),
            ("signs", of_main(&format!("let x = {}1;", "-".repeat(MANY)))),
            ("parentheses", of_main(&format!("let x = {}1;", "(".repeat(MANY)))),
            ("closed parentheses", of_main(&format!("let x = {}1{};", "(".repeat(MANY), ")".repeat(MANY)))),
            (
                "sums in parentheses",
                of_main(&format!("let x = {}1{};", "(".repeat(MANY / 9), "+1)".repeat(MANY / 9))),
            ),
            ("else if", of_main(&format!("if true {{}}{}", " else if true {}".repeat(MANY / 4)))),
            (
                "else if with comments",
                of_main(&format!("if true {{}}{}", "\n/* a */ else if true {}".repeat(MANY / 4))),
            ),
            ("blocks", of_main(&"{".repeat(MANY))),
            ("types", format!("alias a = {}", "vec2<".repeat(MANY))),
        ] {
            let error = parse(format!("\n// (((\n/* [[[ /* */ \n */{text}").as_bytes()).unwrap_err();
            let line = matches!(error, TextError::TooDeep { line } if line >= 4);
            assert!(line, "{what}: {error:?}");
        }
    }

    /// Found by reading: naga ends comments at more marks than a line feed.
    #[test]
    fn unusual_line_ends_hide_nothing() {
        let sums = format!("//\r{}", of_main(&format!("let x = 1{};", " + 1".repeat(100_000))));
        assert!(matches!(parse(sums.as_bytes()), Err(TextError::TooDeep { line: 1 })));
        for mark in ['\u{b}', '\u{c}', '\u{85}', '\u{200e}', '\u{200f}', '\u{2028}', '\u{2029}'] {
            let text = of_main(&format!("if true {{}}{mark}else if true {{}}"));
            assert_eq!(parse(text.as_bytes()).err(), Some(TextError::Mark { line: 1, mark }));
        }
    }

    #[test]
    fn what_is_long_but_flat_is_none_of_it() {
        let table = "1u, ".repeat(20_000);
        let statements = "x += 1u * (x - 2u); ".repeat(5_000);
        let ifs = "if true { x++; } else { x--; } ".repeat(5_000);
        let deep = format!("x = {}1u{};", "(".repeat(100), ")".repeat(100));
        let text = format!(
            "const T = array<u32, 20000>({table});\n{}",
            of_main(&format!("var x = T[7]; {statements} {ifs} {deep}"))
        );
        assert_eq!(parse(text.as_bytes()).err(), None);
    }

    #[test]
    fn declarations_without_end_are_refused_by_their_line() {
        let chain = |count: usize| -> String {
            (0..count)
                .map(|f| format!("fn f{f}() {{ f{}(); }}\n", f + 1))
                .chain([format!("fn f{count}() {{}}")])
                .collect()
        };
        assert_eq!(parse(chain(MAX_DECLARATIONS / 2).as_bytes()).err(), None);
        let error = parse(chain(20_000).as_bytes()).unwrap_err();
        assert_eq!(error, TextError::TooMany { line: MAX_DECLARATIONS + 1 });
    }

    #[test]
    fn calls_that_multiply_are_refused() {
        let functions = |twice: usize| {
            let doubled =
                (0..twice).map(|f| format!("fn f{}() -> u32 {{ return f{f}() + f{f}(); }}\n", f + 1));
            let text: String = doubled.collect();
            format!("fn f0() -> u32 {{ return 1u; }}\n{text}{}", of_main(&format!("var x = f{twice}();")))
        };
        assert_eq!(parse(functions(10).as_bytes()).err(), None, "1,024 calls");
        let error = parse(functions(30).as_bytes()).unwrap_err();
        assert!(matches!(&error, TextError::TooMuch { function } if function.starts_with('f')), "{error}");
    }

    #[test]
    fn messages_are_short_and_name_the_place() {
        let error = parse(of_main(&format!("let x = \"{}", "a".repeat(100_000))).as_bytes()).unwrap_err();
        assert!(error.to_string().len() <= MAX_MESSAGE_BYTES + 3, "{} B", error.to_string().len());
        assert!(parse(b"fn main( {").unwrap_err().to_string().contains(":1:"), "the line is named");
        assert!(matches!(parse(&[0xff]), Err(TextError::NotText(_))));
        assert!(matches!(parse(&vec![b' '; MAX_TEXT_BYTES + 1]), Err(TextError::TooLong { .. })));
    }
}
