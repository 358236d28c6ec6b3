//! What tells a person something stands on one line, its words one space apart. A string that is continued
//! on the next line of the source without a backslash holds a line break, and one that was joined
//! again by hand often holds the indentation.

use proc_macro2::{TokenStream, TokenTree};
use std::fs;
use std::path::Path;

/// Where text is laid out, in columns or over several lines: only errors are looked at there.
const LAID_OUT: &[&str] = &["cmd", "report", "scene/ply.rs", "scene/compressed_ply.rs"];

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
    walk(tokens, !laid_out, &mut found);
    found
}

fn walk(tokens: TokenStream, all: bool, found: &mut Vec<(usize, String)>) {
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
                    walk(group.stream(), all || is_error, found);
                }
                is_test = text == "cfg (test)" || text == "cfg(test)";
                (documents, is_error) = (false, false);
            }
            TokenTree::Literal(literal) => {
                let line = literal.span().start().line;
                if let (true, syn::Lit::Str(text)) = (all && !documents, syn::Lit::new(literal))
                    && has_gap(&text.value())
                {
                    found.push((line, text.value()));
                }
                (documents, is_error) = (false, false);
            }
        }
    }
}

/// Whether words are more than one space apart.
fn has_gap(text: &str) -> bool {
    let words = text.trim();
    words.contains("  ") || words.contains(['\n', '\r', '\t'])
}
