# shellcheck shell=sh
# Sourced by what builds packages: equal sources in the same folder and equal tools give equal bits, whoever builds.
# Paths of the sources and of Cargo's home are replaced in messages; there is no debug information and no symbols.
CARGO_ENCODED_RUSTFLAGS=$(printf -- '--remap-path-prefix=%s=/splat4d\037--remap-path-prefix=%s=/cargo' \
    "$PWD" "${CARGO_HOME:-$HOME/.cargo}")
export CARGO_ENCODED_RUSTFLAGS CARGO_INCREMENTAL=0 CARGO_PROFILE_RELEASE_DEBUG=0 CARGO_PROFILE_RELEASE_STRIP=symbols
# Times inside of the packages: that of the commit.
export SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}"
# The program carries its commit; it then has no need of the path of its sources.
if [ -z "${SPLAT4D_COMMIT:-}" ] && commit=$(git describe --always --dirty --abbrev=12 2>/dev/null); then
    export SPLAT4D_COMMIT="$commit"
fi
