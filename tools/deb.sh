#!/usr/bin/env bash
# Builds the Debian package into DIR (default: out/deb): the program, manual pages and completions. Needs cargo-deb
# (cargo install cargo-deb) and dpkg-dev.
#
#   tools/deb.sh [DIR]
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "${1:-out/deb}"
out=$(cd "${1:-out/deb}" && pwd)
. tools/rust-path.sh
. tools/release-env.sh
cargo build --release --locked --bin splat4d
release=${CARGO_TARGET_DIR:-target}/release
# [package.metadata.deb] in Cargo.toml says where they go.
rm -rf "$release/deb"
mkdir -p "$release/deb"
"$release/splat4d" man "$release/deb/man"
for shell in bash zsh fish; do
    "$release/splat4d" completions "$shell" >"$release/deb/completions.$shell"
done
cargo deb --locked --no-build --no-strip --output "$out"
