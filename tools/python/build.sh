#!/usr/bin/env bash
# Builds the Python wheel, with the command-line program inside, into DIR (default: out/python). Needs maturin.
#
#   tools/python/build.sh [DIR]
set -euo pipefail
cd "$(dirname "$0")/../.."
mkdir -p "${1:-out/python}"
out=$(cd "${1:-out/python}" && pwd)
. tools/rust-path.sh
. tools/release-env.sh
bin=tools/python/python/splat4d/bin
cargo build --release --locked --bin splat4d
mkdir -p "$bin"
trap 'rm -rf "$bin"' EXIT
install "${CARGO_TARGET_DIR:-target}/release/splat4d" "$bin/splat4d"
maturin build --release --locked --manifest-path tools/python/Cargo.toml --out "$out"
