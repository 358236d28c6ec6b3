//! Checks which part of the crate may use which, from the paths in the source.

use proc_macro2::{Delimiter, TokenStream, TokenTree};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// The parts that each part may name, besides itself. By design, a part sees only parts listed before it.
pub const MAY_SEE: &[(&str, &[&str])] = &[
    ("error", &[]),
    ("types", &["error"]),
    ("io", &["error"]),
    ("vk", &["error"]),
    ("gpu", &["error", "vk"]),
    // The unsafe entry points into the safe layer, for hosts.
    ("embed", &["error", "vk", "gpu"]),
    ("kernels", &["error", "types", "gpu"]),
    ("oracle", &["error", "types"]),
    ("ops", &["error", "types", "gpu", "kernels"]),
    ("geometry", &["error", "types"]),
    ("scene", &["error", "types", "io"]),
    ("camera_path", &["error", "types", "geometry", "scene"]),
    ("data", &["error", "types", "io"]),
    ("eval", &["error", "types", "io", "geometry"]),
    // Renders a scene's frames with the ops, for training and for users.
    ("renderer", &["error", "types", "gpu", "ops", "scene"]),
    // Serves rendered images, and the input frames beside them, to a browser.
    ("view", &["error", "types", "io", "gpu", "data", "scene", "renderer"]),
    ("report", &["error", "types", "io"]),
    ("observe", &["error", "types", "io", "gpu", "ops", "geometry", "data"]),
    ("track", &["error", "types", "io", "gpu", "ops", "geometry", "data", "observe"]),
    (
        "train",
        &[
            "error", "types", "io", "gpu", "ops", "geometry", "data", "observe", "track", "scene",
            "eval", "renderer",
        ],
    ),
    // Tests every part, so it sees every part; only the command line sees it.
    (
        "check",
        &[
            "error", "types", "io", "gpu", "kernels", "oracle", "ops", "geometry", "scene", "data",
            "report", "train",
        ],
    ),
    // Compares ops and pipelines with the oracle and times them: it sees what it measures.
    (
        "bench",
        &[
            "error", "types", "gpu", "kernels", "oracle", "ops", "geometry", "scene", "renderer",
            "report", "check", "train",
        ],
    ),
    // The C interface: what a host may use, under C names.
    ("capi", &["error", "types", "gpu", "embed", "ops", "scene", "renderer", "train"]),
    // The command line names the crate as any other user does.
    ("cmd", &[]),
];

/// Parts that may use `unsafe` and `ash`: Vulkan itself, the functions with which a host lends its
/// objects, and the C interface.
const UNSAFE: &[&str] = &["vk", "embed", "capi"];

/// Parts that unit tests may name in addition: those without Vulkan, as reference and as input.
const TESTS_MAY_SEE: &[&str] =
    &["error", "types", "io", "oracle", "geometry", "scene", "data", "eval"];

/// Parts that not even unit tests may name.
const CLOSED_TO_TESTS: &[&str] = &["error", "types", "vk", "gpu", "kernels", "cmd"];

/// Every violation in a source tree, as `file:line: what`.
pub fn breaches(src: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let lib = fs::read_to_string(src.join("lib.rs")).expect("src/lib.rs");
    let reexports = reexports(&lib);
    let sources: Vec<(PathBuf, String)> = super::files(src, "rs")
        .into_iter()
        .map(|path| {
            let source = fs::read_to_string(&path).expect("a readable source file");
            (path.strip_prefix(src).expect("below src").to_owned(), source)
        })
        .collect();
    let tests: BTreeSet<Vec<String>> =
        sources.iter().flat_map(|(inner, source)| test_modules(inner, source)).collect();
    for (inner, source) in &sources {
        let is_test = tests.iter().any(|test| module_of(inner).starts_with(test));
        found.extend(breaches_of(inner, source, &reexports, is_test));
    }
    found
}

/// The violations in one file. `inner` is its path below `src/`. A test file is one that another file
/// declares under `cfg(test)`.
pub fn breaches_of(
    inner: &Path,
    source: &str,
    reexports: &BTreeMap<String, String>,
    is_test: bool,
) -> Vec<String> {
    let tokens: TokenStream = match source.parse() {
        Ok(tokens) => tokens,
        Err(error) => return vec![format!("{}: {error}", inner.display())],
    };
    let module = module_of(inner);
    let part = match module.first().map(String::as_str) {
        None if inner == Path::new("main.rs") => "cmd".to_owned(),
        None => "lib".to_owned(),
        Some(part) => part.to_owned(),
    };
    let mut scan = Scan { part, module, reexports, test: is_test, found: Vec::new() };
    if scan.part != "lib" && !MAY_SEE.iter().any(|(name, _)| *name == scan.part) {
        scan.found.push((1, format!("{} has no place in the layering table", scan.part)));
    }
    scan.walk(tokens);
    scan.found.iter().map(|(line, what)| format!("{}:{line}: {what}", inner.display())).collect()
}

/// The module path of a file: `a/b/c.rs` and `a/b/c/mod.rs` give `[a, b, c]`; the crate's roots give
/// `[]`.
fn module_of(inner: &Path) -> Vec<String> {
    let stem = inner.with_extension("");
    let mut module: Vec<String> =
        stem.iter().map(|part| part.to_string_lossy().into_owned()).collect();
    let last = module.last().map(String::as_str);
    if last == Some("mod") || (module.len() == 1 && matches!(last, Some("lib" | "main"))) {
        module.pop();
    }
    module
}

/// The modules in separate files that a file declares under `cfg(test)`.
fn test_modules(inner: &Path, source: &str) -> Vec<Vec<String>> {
    let tokens: Vec<TokenTree> =
        source.parse::<TokenStream>().unwrap_or_default().into_iter().collect();
    let mut found = Vec::new();
    for (at, token) in tokens.iter().enumerate() {
        if let (true, [_, TokenTree::Ident(name), end, ..]) =
            (is_ident(token, "mod"), &tokens[at..])
            && is_punct(end, ';')
            && follows_cfg_test(&tokens[..at])
        {
            let mut module = module_of(inner);
            module.push(name.to_string());
            found.push(module);
        }
    }
    found
}

/// The part that each name at the crate's root comes from, read from lines such as `pub use
/// error::{Error, Result};`.
fn reexports(lib: &str) -> BTreeMap<String, String> {
    let mut names = BTreeMap::new();
    let tokens: Vec<TokenTree> =
        lib.parse::<TokenStream>().expect("src/lib.rs parses").into_iter().collect();
    for (at, token) in tokens.iter().enumerate() {
        if !is_ident(token, "use") {
            continue;
        }
        let mut path = &tokens[at + 1..];
        if let [first, a, b, ..] = path
            && (is_ident(first, "crate") || is_ident(first, "self"))
            && is_colons(a, b)
        {
            path = &path[3..];
        }
        let [TokenTree::Ident(part), ..] = path else { continue };
        for token in path.iter().skip(1).take_while(|token| !is_punct(token, ';')) {
            for name in idents(token) {
                names.insert(name, part.to_string());
            }
        }
    }
    names
}

fn idents(token: &TokenTree) -> Vec<String> {
    match token {
        TokenTree::Ident(ident) => vec![ident.to_string()],
        TokenTree::Group(group) => group.stream().into_iter().flat_map(|t| idents(&t)).collect(),
        _ => Vec::new(),
    }
}

struct Scan<'a> {
    part: String,
    module: Vec<String>,
    reexports: &'a BTreeMap<String, String>,
    test: bool,
    found: Vec<(usize, String)>,
}

impl Scan<'_> {
    /// Whether the part may name Vulkan handles and use `unsafe`.
    fn is_unsafe(&self) -> bool {
        UNSAFE.contains(&self.part.as_str())
    }

    fn walk(&mut self, tokens: TokenStream) {
        let tokens: Vec<TokenTree> = tokens.into_iter().collect();
        let mut at = 0;
        while at < tokens.len() {
            let token = &tokens[at];
            match token {
                TokenTree::Ident(ident) if *ident == "crate" => self.read_from_root(&tokens, at),
                TokenTree::Ident(ident) if *ident == "super" => {
                    at = self.read_from_super(&tokens, at)
                }
                TokenTree::Ident(ident) if *ident == "ash" && !self.is_unsafe() => {
                    self.report(token, "only src/vk, src/embed and src/capi name ash".into());
                }
                TokenTree::Ident(ident) if *ident == "unsafe" && !self.is_unsafe() => {
                    self.report(token, "`unsafe` belongs in src/vk, src/embed or src/capi".into());
                }
                // `mod name { … }` is a module: it changes what `super` means, and may hold tests.
                TokenTree::Ident(ident) if *ident == "mod" => {
                    if let (Some(TokenTree::Ident(name)), Some(TokenTree::Group(body))) =
                        (tokens.get(at + 1), tokens.get(at + 2))
                        && body.delimiter() == Delimiter::Brace
                    {
                        let outer = self.test;
                        self.test |= follows_cfg_test(&tokens[..at]);
                        self.module.push(name.to_string());
                        self.walk(body.stream());
                        self.module.pop();
                        self.test = outer;
                        at += 2;
                    }
                }
                TokenTree::Group(group) => self.walk(group.stream()),
                _ => {}
            }
            at += 1;
        }
    }

    /// Reads a path `crate::…` at token `at`.
    fn read_from_root(&mut self, tokens: &[TokenTree], at: usize) {
        match &tokens[at + 1..] {
            [a, b, target, ..] if is_colons(a, b) => self.target(target),
            // `pub(crate)` and `in crate` do not name a part.
            [] => {}
            [next, ..] if is_ident(next, "as") => {
                self.report(next, "`crate` under another name hides what is used".into());
            }
            _ => {}
        }
    }

    /// Reads a path `super::super::…` at token `at`; returns the index of its end.
    fn read_from_super(&mut self, tokens: &[TokenTree], mut at: usize) -> usize {
        let mut up = 1;
        while let [a, b, next, ..] = &tokens[at + 1..]
            && is_colons(a, b)
        {
            if is_ident(next, "super") {
                up += 1;
                at += 3;
                continue;
            }
            // Above the part's root, the next name is a part.
            if up >= self.module.len() {
                self.target(next);
            }
            break;
        }
        at
    }

    /// Reads the names after `crate::`: one, or several in braces.
    fn target(&mut self, target: &TokenTree) {
        match target {
            TokenTree::Ident(name) => {
                let name = name.to_string();
                let part = self.reexports.get(&name).unwrap_or(&name).clone();
                if !self.may_see(&part) {
                    let what = format!("{} may not see {part}", self.part);
                    self.report(target, what);
                }
            }
            TokenTree::Group(group) => {
                let mut starts = true;
                for token in group.stream() {
                    if is_punct(&token, ',') {
                        starts = true;
                    } else if starts {
                        starts = false;
                        self.target(&token);
                    }
                }
            }
            other => self.report(other, "a glob over the crate hides what is used".into()),
        }
    }

    fn may_see(&self, part: &str) -> bool {
        // `src/lib.rs` declares the parts, so it may name all of them.
        if self.part == "lib" || part == self.part || part == "self" {
            return true;
        }
        let sees = MAY_SEE
            .iter()
            .find(|(part, _)| *part == self.part)
            .is_some_and(|(_, seen)| seen.contains(&part));
        let test = self.test
            && TESTS_MAY_SEE.contains(&part)
            && !CLOSED_TO_TESTS.contains(&self.part.as_str());
        sees || test
    }

    fn report(&mut self, token: &TokenTree, what: String) {
        self.found.push((token.span().start().line, what));
    }
}

/// Whether the attributes at the end of the tokens read so far contain `cfg(test)`.
fn follows_cfg_test(before: &[TokenTree]) -> bool {
    let mut rest = before;
    while let [head @ .., last] = rest {
        match last {
            TokenTree::Group(group) if group.delimiter() == Delimiter::Bracket => {
                let text: String = group.stream().to_string().split_whitespace().collect();
                if text == "cfg(test)" {
                    return true;
                }
                rest = head;
            }
            TokenTree::Punct(punct) if punct.as_char() == '#' => rest = head,
            TokenTree::Ident(ident) if *ident == "pub" => rest = head,
            TokenTree::Group(group) if group.delimiter() == Delimiter::Parenthesis => rest = head,
            _ => return false,
        }
    }
    false
}

fn is_ident(token: &TokenTree, name: &str) -> bool {
    matches!(token, TokenTree::Ident(ident) if *ident == name)
}

fn is_punct(token: &TokenTree, character: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == character)
}

fn is_colons(a: &TokenTree, b: &TokenTree) -> bool {
    is_punct(a, ':') && is_punct(b, ':')
}
