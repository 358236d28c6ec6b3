# shellcheck shell=bash
# Sourced. Rust as rustup installs it comes onto the path, as in a new login shell, if it is not there.
if [[ -f ${CARGO_HOME:-$HOME/.cargo}/env ]]; then
    # shellcheck source=/dev/null
    . "${CARGO_HOME:-$HOME/.cargo}/env"
fi
