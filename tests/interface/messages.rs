//! Checks that messages for users are on one line, with single spaces between words. A string literal
//! that continues on the next source line without a backslash contains a line break, and one that was
//! joined by hand often contains the indentation.

use proc_macro2::{TokenStream, TokenTree};
use std::fs;
use std::path::Path;

/// Files that lay out text in columns or over several lines: only errors are checked there.
const LAID_OUT: &[&str] = &["cmd", "report", "scene/ply.rs", "scene/compressed_ply.rs"];

/// Parts that may name options of the command line.
const OF_THE_COMMAND_LINE: &[&str] = &["cmd", "main.rs"];

/// Every string literal with a gap in a source tree, as `file:line: text`.
pub fn gaps(src: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for path in super::files(src, "rs") {
        let inner = path.strip_prefix(src).expect("below src").to_owned();
        let source = fs::read_to_string(&path).expect("a readable source file");
        let laid_out = LAID_OUT.iter().any(|part| inner.starts_with(part));
        for (line, text) in gaps_of(&source, laid_out) {
            found.push(format!("{}:{line}: {text:?}", inner.display()));
        }
    }
    found
}

/// The string literals with a gap in one file, each with its line. With `laid_out`, only those inside
/// `Error::…(…)` and `Err(…)`.
pub fn gaps_of(source: &str, laid_out: bool) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let tokens: TokenStream = source.parse().expect("a source file parses");
    walk(tokens, !laid_out, &has_gap, &mut found);
    found
}

/// Collects the string literals for which `is_wrong` holds, each with its line: from `all` literals, or
/// only from those in errors.
fn walk(
    tokens: TokenStream,
    all: bool,
    is_wrong: &impl Fn(&str) -> bool,
    found: &mut Vec<(usize, String)>,
) {
    // Whether the next token is documentation (`#[doc = "…"]`, which `///` and `//!` expand to), a test
    // or an error.
    let (mut documents, mut is_test, mut is_error) = (false, false, false);
    for token in tokens {
        match token {
            TokenTree::Ident(ident) => {
                documents = ident == "doc";
                is_error = ident == "Err" || ident == "Error" || is_error;
            }
            // `Error::Input(…)`, `Error::Shape { … }`.
            TokenTree::Punct(punct) => {
                documents &= punct.as_char() == '=';
                is_error &= punct.as_char() == ':';
                is_test &= punct.as_char() == '#';
            }
            TokenTree::Group(group) => {
                let text = group.stream().to_string();
                if !is_test {
                    walk(group.stream(), all || is_error, is_wrong, found);
                }
                is_test = text == "cfg (test)" || text == "cfg(test)";
                (documents, is_error) = (false, false);
            }
            TokenTree::Literal(literal) => {
                let line = literal.span().start().line;
                if let (true, syn::Lit::Str(text)) = (all && !documents, syn::Lit::new(literal))
                    && is_wrong(&text.value())
                {
                    found.push((line, text.value()));
                }
                (documents, is_error) = (false, false);
            }
        }
    }
}

/// Every string literal of the library that names a command-line option, as `file:line: text`: users of
/// the library have no such options.
pub fn options(src: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for path in super::files(src, "rs") {
        let inner = path.strip_prefix(src).expect("below src").to_owned();
        if OF_THE_COMMAND_LINE.iter().any(|part| inner.starts_with(part)) {
            continue;
        }
        let source = fs::read_to_string(&path).expect("a readable source file");
        let tokens: TokenStream = source.parse().expect("a source file parses");
        let mut texts = Vec::new();
        walk(tokens, true, &names_option, &mut texts);
        found.extend(
            texts.iter().map(|(line, text)| format!("{}:{line}: {text:?}", inner.display())),
        );
    }
    found
}

/// Whether a text names a command-line option. A text that consists of an option is an argument for
/// another program, and does not count.
pub fn names_option(text: &str) -> bool {
    let is_option = |word: &str| {
        let name = word.trim_start_matches(|c: char| !c.is_alphanumeric() && c != '-');
        let name = name.strip_prefix("--");
        name.is_some_and(|name| name.starts_with(|c: char| c.is_ascii_lowercase()))
    };
    !text.starts_with("--") && text.split_whitespace().any(is_option)
}

/// Whether a text has more than one space between words.
fn has_gap(text: &str) -> bool {
    let words = text.trim();
    words.contains("  ") || words.contains(['\n', '\r', '\t'])
}
