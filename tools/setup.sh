#!/usr/bin/env bash
# Installs what is missing, with apt or dnf, and Rust with its own installer; does nothing when all is there.
#
#   tools/setup.sh run    what building and running need: linker, Vulkan loader, lavapipe, ffmpeg, Rust
#   tools/setup.sh test   and what the test suite needs: validation layer, SwiftShader, CMake, the evo,
#                         scikit-image, onnxruntime, numpy, pytest, snakemake and kubernetes-validate packages, and
#                         Node.js with PlayCanvas' splat-transform, Khronos' glTF validator and the packages of
#                         the page's player; with apt only
#
# SPLAT4D_NO_RUSTUP=1 makes a missing or too old Rust an error instead of installing it.
set -euo pipefail
cd "$(dirname "$0")/.."

mode=${1:-run}
case $mode in
run | test) ;;
*)
    echo "usage: tools/setup.sh [run|test]" >&2
    exit 2
    ;;
esac

fail() {
    echo "setup: $*" >&2
    exit 1
}

# Whether a command, or a file of one of these patterns, is there.
has_command() { command -v "$1" >/dev/null 2>&1; }
has_file() { compgen -G "$1" >/dev/null; }
has_loader() {
    has_file '/usr/lib/*/libvulkan.so.1' || has_file '/usr/lib*/libvulkan.so.1' ||
        has_file '/usr/local/lib*/libvulkan.so.1'
}
has_lavapipe() { has_file '/usr/share/vulkan/icd.d/lvp_icd*.json'; }
has_validation() { has_file '/usr/share/vulkan/explicit_layer.d/VkLayer_khronos_validation.json'; }
has_module() { python3 -c "import $1" >/dev/null 2>&1; }
has_swiftshader() { has_file '/usr/lib/chromium/vk_swiftshader_icd.json'; }
has_certificates() { has_file /etc/ssl/certs/ca-certificates.crt || has_file /etc/pki/tls/certs/ca-bundle.crt; }
rust_version() { rustc --version 2>/dev/null | cut -d' ' -f2 || true; }
# Whether cargo and rustc are there, and rustc is not older than the crate wants.
has_rust() {
    has_command cargo && has_command rustc &&
        [[ $(printf '%s\n' "$wanted" "$(rust_version)" | sort -V | head -n1) == "$wanted" ]]
}

# One probe and the package that satisfies it: apt's name, and dnf's if it is another.
needs=(
    'has_command cc|g++|gcc'
    'has_loader|libvulkan1|vulkan-loader'
    'has_lavapipe|mesa-vulkan-drivers'
    'has_command ffmpeg|ffmpeg|ffmpeg-free'
)

. tools/rust-path.sh
wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
lacking=
if ! has_rust; then
    found=$(rust_version)
    lacking="Rust $wanted or newer is missing"
    if [[ -n $found ]]; then
        lacking="Rust $found is too old, $wanted is needed"
    fi
    if [[ ${SPLAT4D_NO_RUSTUP:-} == 1 ]]; then
        fail "$lacking; install it with: curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh" \
            "  (https://rustup.rs)"
    fi
    # The installer is fetched with these.
    has_command rustup || needs+=('has_command curl|curl' 'has_certificates|ca-certificates')
fi
if [[ $mode == test ]]; then
    needs+=(
        'has_command c++|g++'
        'has_command valgrind|valgrind'
        'has_command pkg-config|pkg-config'
        'has_file /usr/include/vulkan/vulkan.h|libvulkan-dev'
        'has_command cmake|cmake'
        'has_command ninja|ninja-build'
        'has_command python3|python3'
        # Where it is absent, no environment of its own can be made.
        'has_module ensurepip|python3-venv'
        'has_command git|git'
        'has_command node|nodejs'
        'has_command npm|npm'
        'has_command spirv-val|spirv-tools'
        'has_validation|vulkan-validationlayers'
        # Debian ships SwiftShader inside of its browser only.
        'has_swiftshader|chromium'
        # The viewer's page is tested in it.
        'has_command chromium|chromium'
    )
fi

manager='apt-get'
if ! has_command apt-get && has_command dnf && [[ $mode == run ]]; then
    manager=dnf
fi
missing=()
find_missing() {
    missing=()
    local need probe apt dnf
    for need in "${needs[@]}"; do
        IFS='|' read -r probe apt dnf <<<"$need"
        # The probe is a function above and its argument.
        $probe && continue
        if [[ $manager == dnf ]]; then
            missing+=("${dnf:-$apt}")
        else
            missing+=("$apt")
        fi
    done
}

find_missing
if ((${#missing[@]})); then
    has_command $manager || fail "missing: ${missing[*]} (Debian's names), and there is no apt-get to install them"
    as_root=()
    if [[ $(id -u) != 0 ]]; then
        has_command sudo || fail "run as root: $manager install ${missing[*]}"
        as_root=(sudo)
    fi
    echo "setup: installing ${missing[*]}"
    if [[ $manager == dnf ]]; then
        install=(dnf install -y -q --setopt=install_weak_deps=False)
    else
        "${as_root[@]}" apt-get update -qq || fail "apt-get update failed; is there a network?"
        install=(env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends)
    fi
    "${as_root[@]}" "${install[@]}" "${missing[@]}" || fail "$manager could not install ${missing[*]}"
    find_missing
    ((${#missing[@]} == 0)) || fail "still missing after the installation: ${missing[*]}"
fi

if [[ -n $lacking ]]; then
    if has_command rustup; then
        echo "setup: $lacking; running: rustup update stable"
        rustup update stable || fail "rustup could not update Rust; is there a network?"
    else
        echo "setup: $lacking; running its own installer (https://rustup.rs), which writes to" \
            "${RUSTUP_HOME:-$HOME/.rustup} and ${CARGO_HOME:-$HOME/.cargo} and adds the latter to the path in the" \
            "shell's profile; SPLAT4D_NO_RUSTUP=1 prevents it"
        curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs |
            sh -s -- -y --profile minimal --default-toolchain stable ||
            fail "Rust's installer failed; is there a network?"
        . tools/rust-path.sh
    fi
    has_rust || fail "Rust is still too old or missing: $(command -v rustc || echo "no rustc on the path")" \
        "$(rust_version); remove it, or select a newer one (rustup default stable)"
fi
if [[ $mode == test ]]; then
    for component in rustfmt clippy; do
        has_command "cargo-${component/rustfmt/fmt}" && continue
        has_command rustup || fail "$component is missing and there is no rustup to add it"
        rustup component add "$component" || fail "rustup could not add $component"
    done
fi
# Tests compare errors of trajectories with those of the evo package and pictures with those of scikit-image,
# run networks through the ONNX Runtime of the onnxruntime package, and jobs by Snakemake. They lie beside the
# build, in environments of their own, so that the system's Python stays as it is.
if [[ $mode == test ]]; then
    beside=${CARGO_TARGET_DIR:-target}
    # python_package NAME PROBE PIP_ARGUMENTS …: unless the probe runs in NAME's environment.
    python_package() {
        local place=$beside/$1 probe=$2
        "$place/bin/python" -c "$probe" >/dev/null 2>&1 && return
        echo "setup: installing $1 into $place"
        python3 -m venv --clear "$place" || fail "python3 could not make an environment in $place"
        "$place/bin/pip" install --quiet --disable-pip-version-check "${@:3}" ||
            fail "pip could not install $1 into $place; is there a network?"
        "$place/bin/python" -c "$probe" || fail "$1 was installed into $place and does not run"
    }
    python_package evo 'import evo.main_rpe, skimage.metrics' 'evo>=1.30,<2' 'scikit-image>=0.22,<1'
    # The library alone is used.
    python_package onnxruntime 'import importlib.util as u; assert u.find_spec("onnxruntime")' \
        --no-deps 'onnxruntime>=1.17,<2'
    # The Python package is tested with these.
    python_package pytest 'import numpy, pytest' 'numpy>=1.22,<3' 'pytest>=7,<10'
    # What `batch --emit` writes is run by the one and held against the schemas of the other.
    python_package engines 'import snakemake, kubernetes_validate' \
        'snakemake==9.27.1' 'kubernetes-validate==1.37.0'
    # npm_packages NAME FOLDER: the packages of the lock file in FOLDER, into NAME. No script of a package runs.
    npm_packages() {
        local place=$beside/$1 list=$2
        cmp -s "$list/package-lock.json" "$place/package-lock.json" && [[ -d $place/node_modules ]] && return
        echo "setup: installing the packages of $list into $place"
        rm -rf "$place" "$place.part"
        mkdir -p "$place.part"
        cp "$list/package.json" "$list/package-lock.json" "$place.part"
        npm ci --silent --ignore-scripts --no-audit --no-fund --prefix "$place.part" ||
            fail "npm could not install the packages of $list; is there a network?"
        mv "$place.part" "$place"
    }
    node -e "process.exit(Number(process.versions.node.split('.')[0]) < 18 ? 1 : 0)" ||
        fail "node $(node --version) is too old, 18 is needed; see https://nodejs.org"
    # What `export` writes is read by other programs of the formats, and what these write is read here.
    npm_packages splats tools/splats
    # The player inside of exported pages is built anew.
    npm_packages player tools/player
fi
echo "setup: everything for '$mode' is there (Rust $(rust_version))"
