//! The crate's public interface, compared with a committed list, and the content of its package. Needs no
//! device.
//!
//! The list is read from the source (`syn`): every `pub` item with its signature, fields, variants,
//! derives and features, by module; re-exports are listed as written. The list contains slightly more
//! than users can reach (a `pub` item of a private module is listed even if only its re-export is
//! reachable), and nothing that they can reach is missing. Modules without a stable interface are left out. `SPLAT4D_UPDATE_API=1` rewrites the list.

use proc_macro2::{Delimiter, Group, TokenStream, TokenTree};
use quote::{ToTokens, quote};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use syn::{Attribute, Fields, ImplItem, Item, Visibility};

const LIST: &str = "tests/api/public.txt";

/// Modules without a stable interface: the command line, which is another crate, and modules for it and
/// for tests, which change with every kernel. The crate's documentation names them.
const UNPROMISED: &[&str] = &["main", "cmd", "bench", "check", "kernels", "oracle", "report"];

#[test]
fn the_public_interface_is_the_committed_one() {
    let found = listing(&root().join("src"));
    let path = root().join(LIST);
    if std::env::var("SPLAT4D_UPDATE_API").is_ok_and(|value| value == "1") {
        std::fs::write(&path, found.join("\n") + "\n").unwrap();
        return;
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let committed: BTreeSet<&str> = committed.lines().collect();
    let found: BTreeSet<&str> = found.iter().map(String::as_str).collect();
    let mut text = String::new();
    for line in committed.difference(&found) {
        text += &format!("- {line}\n");
    }
    for line in found.difference(&committed) {
        text += &format!("+ {line}\n");
    }
    assert!(
        text.is_empty(),
        "the public interface has changed; what is gone or different breaks hosts, so say it in \
         CHANGELOG.md, and write the list with SPLAT4D_UPDATE_API=1 cargo test --test api\n{text}"
    );
}

#[test]
fn the_list_notices_every_kind_of_change() {
    let list = |source: &str| {
        let mut lines = Vec::new();
        items(&syn::parse_file(source).unwrap().items, "m", &mut lines);
        lines
    };
    let base = "
        pub struct S { pub a: u32, b: u8 }
        impl S { pub fn f(&self, x: u32) -> u32 { x } fn g() {} }
        pub enum E { A, B(u32) } pub trait T { fn f(&self); } pub const C: u32 = 1;
        mod inner { pub fn unreached() {} } #[cfg(test)] mod tests { pub fn t() {} }";
    let lines = list(base);
    assert!(lines.contains(&"m impl S pub fn f(&self,x:u32)->u32".to_owned()), "{lines:#?}");
    for (from, to) in [
        ("pub a: u32", "pub a: u64"),
        ("pub a: u32", "a: u32"),
        ("x: u32", "x: u64"),
        ("pub fn f", "fn f"),
        ("pub fn f", "pub unsafe fn f"),
        ("B(u32)", "B(u64)"),
        ("B(u32)", "B(u32), D"),
        ("fn f(&self);", "fn f(&self); fn h(&self);"),
        ("C: u32", "C: u64"),
        ("pub struct S", "#[derive(Clone)] pub struct S"),
        ("pub struct S", "#[cfg(feature = \"files\")] pub struct S"),
        ("pub trait T", "impl Drop for S { fn drop(&mut self) {} } pub trait T"),
    ] {
        assert_ne!(list(&base.replacen(from, to, 1)), lines, "{from} -> {to}");
    }
    for (from, to) in [("{ x }", "{ x + 1 }"), ("b: u8", "c: u16"), ("fn g()", "fn h()")] {
        assert_eq!(list(&base.replacen(from, to, 1)), lines, "{from} -> {to}");
    }
}

/// The package contains the source, the shaders and their SPIR-V modules, the C header, and nothing else.
#[test]
fn the_package_holds_what_it_needs_and_nothing_more() {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["package", "--list", "--allow-dirty", "--offline"])
        .current_dir(root())
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let listed: BTreeSet<&str> = text.lines().collect();
    for file in ["Cargo.toml", "README.md", "CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"] {
        assert!(listed.contains(file), "{file} is missing");
    }
    for folder in ["src", "spirv", "glsl", "include", "examples/custom_kernel"] {
        for path in files(&root().join(folder)) {
            let inner = path.strip_prefix(root()).unwrap().to_string_lossy().into_owned();
            assert!(listed.contains(inner.as_str()), "{inner} is missing");
        }
    }
    let generated = ["Cargo.lock", "Cargo.toml.orig", ".cargo_vcs_info.json"];
    let beside: Vec<_> = listed
        .iter()
        .filter(|file| {
            let folders = ["src/", "spirv/", "glsl/", "include/", "examples/"];
            !folders.iter().any(|folder| file.starts_with(folder))
        })
        .filter(|file| !generated.contains(file))
        .collect();
    assert_eq!(beside.len(), 5, "{beside:?}");
    // The examples are separate packages that depend on this one.
    assert!(!listed.iter().any(|file| file.starts_with("examples/wgpu-host")));
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Every file below a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => found.extend(files(&path)),
            false => found.push(path),
        }
    }
    found.sort();
    found
}

fn listing(src: &Path) -> Vec<String> {
    let mut lines = Vec::new();
    for path in files(src) {
        let inner = path.strip_prefix(src).unwrap().with_extension("");
        let mut module: Vec<_> = inner.iter().map(|part| part.to_string_lossy()).collect();
        let is_source = path.extension().is_some_and(|extension| extension == "rs");
        if !is_source || UNPROMISED.contains(&&*module[0]) {
            continue;
        }
        if module.last().is_some_and(|last| last == "mod" || last == "lib") {
            module.pop();
        }
        let module = module.join("::");
        let module = if module.is_empty() { "crate" } else { &module };
        let source = std::fs::read_to_string(&path).unwrap();
        let file =
            syn::parse_file(&source).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        items(&file.items, module, &mut lines);
    }
    lines.sort();
    lines
}

/// Adds a line for each item that users can name.
fn items(all: &[Item], module: &str, lines: &mut Vec<String>) {
    let line = |attributes: &[Attribute], tokens: TokenStream| {
        format!("{module} {}{}", marks(attributes), compact(tokens))
    };
    for item in all {
        match item {
            Item::Fn(f) if open(&f.vis) => {
                let sig = &f.sig;
                lines.push(line(&f.attrs, quote!(pub #sig)));
            }
            Item::Struct(s) if open(&s.vis) => {
                let (name, generics, fields) = (&s.ident, &s.generics, fields(&s.fields, false));
                lines.push(line(&s.attrs, quote!(pub struct #name #generics #fields)));
            }
            Item::Enum(e) if open(&e.vis) => {
                let (name, generics) = (&e.ident, &e.generics);
                let variants = e.variants.iter().map(|variant| {
                    let (name, fields) = (&variant.ident, fields(&variant.fields, true));
                    quote!(#name #fields)
                });
                lines.push(line(&e.attrs, quote!(pub enum #name #generics { #(#variants,)* })));
            }
            Item::Trait(t) if open(&t.vis) => {
                let mut bare = t.clone();
                bare.attrs.clear();
                let tokens = undocumented(bare.to_token_stream());
                lines.push(line(&t.attrs, tokens));
            }
            Item::Const(c) if open(&c.vis) => {
                let (name, ty) = (&c.ident, &c.ty);
                lines.push(line(&c.attrs, quote!(pub const #name: #ty)));
            }
            Item::Static(s) if open(&s.vis) => {
                let (name, ty) = (&s.ident, &s.ty);
                lines.push(line(&s.attrs, quote!(pub static #name: #ty)));
            }
            Item::Type(t) if open(&t.vis) => {
                let (name, generics, ty) = (&t.ident, &t.generics, &t.ty);
                lines.push(line(&t.attrs, quote!(pub type #name #generics = #ty)));
            }
            Item::Use(u) if open(&u.vis) => {
                let tree = &u.tree;
                lines.push(line(&u.attrs, quote!(pub use #tree)));
            }
            Item::Mod(m) if open(&m.vis) && !is_test(&m.attrs) => {
                let name = &m.ident;
                lines.push(line(&m.attrs, quote!(pub mod #name)));
                if let Some((_, inner)) = &m.content {
                    items(inner, &format!("{module}::{name}"), lines);
                }
            }
            Item::Impl(block) if !is_test(&block.attrs) => {
                let (ty, generics) = (&block.self_ty, &block.generics);
                if let Some((_, path, _)) = &block.trait_ {
                    lines.push(line(&block.attrs, quote!(impl #generics #path for #ty)));
                    continue;
                }
                let head = line(&block.attrs, quote!(impl #generics #ty));
                for item in &block.items {
                    let (attributes, tokens) = match item {
                        ImplItem::Fn(f) if open(&f.vis) => {
                            let sig = &f.sig;
                            (&f.attrs, quote!(pub #sig))
                        }
                        ImplItem::Const(c) if open(&c.vis) => {
                            let (name, ty) = (&c.ident, &c.ty);
                            (&c.attrs, quote!(pub const #name: #ty))
                        }
                        _ => continue,
                    };
                    lines.push(format!("{head} {}{}", marks(attributes), compact(tokens)));
                }
            }
            // `kernel!`: its declaration stands for the items that it generates.
            Item::Macro(m) if m.ident.is_none() => {
                let (path, tokens) = (&m.mac.path, undocumented(m.mac.tokens.clone()));
                lines.push(line(&[], quote!(#path ! #tokens)));
            }
            _ => {}
        }
    }
}

fn open(visibility: &Visibility) -> bool {
    matches!(visibility, Visibility::Public(_))
}

fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|a| compact(a.to_token_stream()) == "#[cfg(test)]")
}

/// The attributes that are visible to users.
fn marks(attributes: &[Attribute]) -> String {
    const NOTICED: [&str; 6] = ["cfg", "cfg_attr", "derive", "must_use", "non_exhaustive", "repr"];
    let noticed = |a: &&Attribute| NOTICED.iter().any(|name| a.path().is_ident(name));
    attributes
        .iter()
        .filter(noticed)
        .map(|a| match a.path().is_ident("must_use") {
            true => "#[must_use] ".to_owned(),
            false => compact(a.to_token_stream()) + " ",
        })
        .collect()
}

/// The fields that users can name; all fields of a variant.
fn fields(all: &Fields, of_variant: bool) -> TokenStream {
    let seen = all.iter().filter(|field| of_variant || open(&field.vis)).map(|field| {
        let mut field = field.clone();
        field.attrs.retain(|a| a.path().is_ident("cfg"));
        field
    });
    let hidden = match !of_variant && all.iter().any(|field| !open(&field.vis)) {
        true => quote!(..),
        false => TokenStream::new(),
    };
    match all {
        Fields::Named(_) => quote!({ #(#seen,)* #hidden }),
        Fields::Unnamed(_) => quote!(( #(#seen,)* #hidden )),
        Fields::Unit => TokenStream::new(),
    }
}

/// Removes doc comments from tokens.
fn undocumented(tokens: TokenStream) -> TokenStream {
    let mut kept: Vec<TokenTree> = Vec::new();
    for token in tokens {
        match token {
            TokenTree::Group(group) => {
                let doc = group.delimiter() == Delimiter::Bracket
                    && group.stream().to_string().starts_with("doc");
                let after_hash =
                    matches!(kept.last(), Some(TokenTree::Punct(p)) if p.as_char() == '#');
                if doc && after_hash {
                    kept.pop();
                    continue;
                }
                let inner = undocumented(group.stream());
                kept.push(TokenTree::Group(Group::new(group.delimiter(), inner)));
            }
            other => kept.push(other),
        }
    }
    kept.into_iter().collect()
}

/// Tokens on one line, with spaces only between words, independent of the token printer.
fn compact(tokens: TokenStream) -> String {
    let text = tokens.to_string();
    let word = |c: char| c.is_alphanumeric() || "_'\"".contains(c);
    let mut out = String::new();
    for part in text.split_whitespace() {
        if out.ends_with(word) && part.starts_with(word) {
            out.push(' ');
        }
        out += part;
    }
    out
}
