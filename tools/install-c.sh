#!/usr/bin/env bash
# Builds the C libraries, shared and static, and installs them with the header and a file for
# pkg-config. Needs Rust and a C linker, nothing else.
#
#   tools/install-c.sh PREFIX             with scene files (feature `files`)
#   tools/install-c.sh PREFIX --bare      the engine alone: splat4d_scene_open and _save fail
set -euo pipefail
cd "$(dirname "$0")/.."

prefix=${1:-}
case ${2:-} in
'') features=capi,files ;;
--bare) features=capi ;;
*) prefix= ;;
esac
if [[ -z $prefix || $prefix == -* ]]; then
    echo "usage: tools/install-c.sh PREFIX [--bare]" >&2
    exit 2
fi
mkdir -p "$prefix"
prefix=$(cd "$prefix" && pwd)
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n1)
# Before 1.0 a minor version may break the interface.
soname=libsplat4d.so.${version%.*}

target=${CARGO_TARGET_DIR:-target}/c
cargo rustc --lib --release --locked --crate-type cdylib,staticlib --no-default-features \
    --features "$features" --target-dir "$target" -- -C "link-arg=-Wl,-soname,$soname"

install -d "$prefix/include" "$prefix/lib/pkgconfig"
install -m 644 include/splat4d.h "$prefix/include/"
install -m 755 "$target/release/libsplat4d.so" "$prefix/lib/libsplat4d.so.$version"
install -m 644 "$target/release/libsplat4d.a" "$prefix/lib/"
strip --strip-debug "$prefix/lib/libsplat4d.so.$version" "$prefix/lib/libsplat4d.a"
ln -sf "libsplat4d.so.$version" "$prefix/lib/$soname"
ln -sf "$soname" "$prefix/lib/libsplat4d.so"
cat >"$prefix/lib/pkgconfig/splat4d.pc" <<PC
prefix=$prefix
libdir=\${prefix}/lib
includedir=\${prefix}/include

Name: splat4d
Description: 4D Gaussian splatting on Vulkan compute
Version: $version
Cflags: -I\${includedir}
Libs: -L\${libdir} -lsplat4d
Libs.private: -lgcc_s -lutil -lrt -lpthread -lm -ldl
PC
echo "splat4d $version (features: $features) is in $prefix"
