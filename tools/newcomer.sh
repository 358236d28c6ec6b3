#!/usr/bin/env bash
# What somebody new does: the README's embedding example, copied into a new crate that depends on
# this one without its default features, built and run. Says how many crates that takes.
set -euo pipefail
cd "$(dirname "$0")/.."

crate=$PWD/out/newcomer
rm -rf "$crate"
mkdir -p "$crate/src"

# The first block of Rust under the heading.
awk '/^## / { inside = ($0 == "## Embedding") }
     /^```/ && inside { if (code) exit; code = /^```rust/; next }
     code { print }' README.md >"$crate/src/main.rs"
cat >"$crate/Cargo.toml" <<TOML
[package]
name = "newcomer"
edition = "2024"

[workspace]

[dependencies]
image = { version = "0.25", default-features = false, features = ["png"] }
splat4d = { path = "../..", default-features = false }
TOML
# The versions that this repository is tested with.
cp Cargo.lock "$crate/"

cd "$crate"
start=$SECONDS
cargo build --quiet
echo "built in $((SECONDS - start)) s"
engine=$(cargo tree -p splat4d -e normal --prefix none | awk '{ print $1 }' | sort -u | wc -l)
echo "splat4d without default features is $engine crates, itself among them"
cargo run --quiet
# A PNG, and not an empty one.
[[ $(head -c 4 ball.png | od -An -c | tr -d ' ') == '211PNG' ]]
[[ $(stat -c %s ball.png) -gt 10000 ]]
echo "drew ball.png"
