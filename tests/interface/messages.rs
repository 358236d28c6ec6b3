//! What tells a person something stands on one line, its words one space apart. A string that is continued
//! on the next line of the source without a backslash holds a line break, and one that was joined
//! again by hand often holds the indentation.

use proc_macro2::{TokenStream, TokenTree};
use std::fs;
use std::path::Path;

/// Where text is laid out, in columns or over several lines: only errors are looked at there.
const LAID_OUT: &[&str] = &["cmd", "report", "scene/ply.rs", "scene/compressed_ply.rs"];

/// Parts that may name options of the command line.
const OF_THE_COMMAND_LINE: &[&str] = &["cmd", "main.rs"];

/// Every text with a gap in a source tree, as `file:line: text`.
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

/// The texts with a gap in one file, each with its line; where text is laid out, those inside of
/// `Error::…(…)` and `Err(…)`.
pub fn gaps_of(source: &str, laid_out: bool) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let tokens: TokenStream = source.parse().expect("a source file parses");
    walk(tokens, !laid_out, &has_gap, &mut found);
    found
}

/// Collects the texts for which `is_wrong`, each with its line; of `all` texts or only those of errors.
fn walk(
    tokens: TokenStream,
    all: bool,
    is_wrong: &impl Fn(&str) -> bool,
    found: &mut Vec<(usize, String)>,
) {
    // Whether what comes next documents an item (`#[doc = "…"]`, which is what `///` and `//!` are,
    // too), is a test or an error.
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

/// Every text of the library that names an option of the command line, as `file:line: text`: those who embed
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

/// Whether a text names an option of a command line; one that is an option itself is given to another
/// program.
pub fn names_option(text: &str) -> bool {
    let is_option = |word: &str| {
        let name = word.trim_start_matches(|c: char| !c.is_alphanumeric() && c != '-');
        let name = name.strip_prefix("--");
        name.is_some_and(|name| name.starts_with(|c: char| c.is_ascii_lowercase()))
    };
    !text.starts_with("--") && text.split_whitespace().any(is_option)
}

/// Whether words are more than one space apart.
fn has_gap(text: &str) -> bool {
    let words = text.trim();
    words.contains("  ") || words.contains(['\n', '\r', '\t'])
}
