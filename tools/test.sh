#!/usr/bin/env bash
# The whole suite: format, lints, docs, shaders, tests; kernels on lavapipe and on SwiftShader, both
# under the validation layer. Every step runs, whatever failed before; any failure fails the whole.
# Full logs lie in out/test/. Needs no GPU; a missing driver fails.
set -uo pipefail
cd "$(dirname "$0")/.." || exit

tools/setup.sh test || exit 1
. tools/rust-path.sh

# One profile, one selection of packages, targets and features, in every step: shaderc and the
# dependencies are then built once.
readonly release=(--release --workspace --features splat4d/capi)
# A panic tells its line without debug information, and some fifty programs are linked faster without it.
export CARGO_PROFILE_RELEASE_DEBUG=0
export CMAKE_TOOLCHAIN_FILE=${CMAKE_TOOLCHAIN_FILE:-$PWD/tools/shaderc.cmake}
readonly target=${CARGO_TARGET_DIR:-target}
readonly logs=out/test
rm -rf "$logs"
mkdir -p "$logs"

# The device is chosen here, by the driver that the loader may see.
# Logs are read by grep.
export CARGO_TERM_COLOR=never
unset SPLAT4D_DEVICE VK_ICD_FILENAMES VK_ADD_DRIVER_FILES
lavapipe=$(compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' | head -n1)
readonly lavapipe
readonly swiftshader=/usr/lib/chromium/vk_swiftshader_icd.json

# Where the real data is, a test that does not find its part of it fails.
if [[ -d ${SPLAT4D_DATA:-../shared/data} ]]; then
    export SPLAT4D_REQUIRE_DATA=1
fi

failed=()
number=0

# step NAME COMMAND …: runs, logs, times. On the terminal: what cargo and the tests report line by
# line; after a failure, the end of the log.
step() {
    local name=$1 start=$SECONDS status log
    shift
    number=$((number + 1))
    log=$(printf '%s/%02d-%s.log' "$logs" "$number" "${name// /-}")
    echo "== $name: $*"
    "$@" 2>&1 | tee "$log" |
        grep --line-buffered -E '^(test |running |error|warning|thread |SKIPPED|[0-9]+ shaders)|^ +(Running|Doc-tests) '
    status=${PIPESTATUS[0]}
    if ((status)); then
        tail -n 150 "$log"
        echo "== $name FAILED after $((SECONDS - start)) s (log: $log)"
        failed+=("$name")
    else
        echo "== $name ok, $((SECONDS - start)) s"
    fi
    return "$status"
}

# Whether a test file runs cases of `check`, or tests the engine under them, or hosts around it.
is_kernel_test() {
    case $1 in
    tests/engine.rs | tests/embed*.rs) true ;;
    tests/geometry.rs) false ;; # its cases run on the host
    *) grep -q 'common::cases!' "$1" ;;
    esac
}

kernel_tests=()
end_to_end=()
others=()
for file in tests/*.rs; do
    name=$(basename "$file" .rs)
    case $name in
    end_to_end | hard_cases | table | capi | cli | cli_* | track | synth | ablate | batch | book)
        end_to_end+=(--test "$name")
        ;;
    *) if is_kernel_test "$file"; then kernel_tests+=(--test "$name"); else others+=(--test "$name"); fi ;;
    esac
done

on() {
    local driver=$1
    shift
    [[ -f $driver ]] || {
        echo "error: no driver at $driver"
        return 1
    }
    # One test at a time: the layer keeps its table of devices without a lock, and crashes now and
    # then when one thread makes or destroys a device while another calls.
    VK_DRIVER_FILES=$driver SPLAT4D_VALIDATION=1 RUST_TEST_THREADS=1 "$@"
}

validate_modules() {
    local module status=0
    while IFS= read -r module; do
        spirv-val --target-env vulkan1.3 --scalar-block-layout "$module" || {
            echo "error: $module is no valid SPIR-V"
            status=1
        }
    done < <(find spirv -name '*.spv' | sort)
    return $status
}

# The crate as others depend on it, from the engine alone up: each set of features on its own. The release
# profile, for it does not optimise procedural macros.
check_features() {
    local features status=0
    for features in '' files reconstruct check bench onnx view cli capi capi,files; do
        echo "features: ${features:-none}"
        RUSTFLAGS="${RUSTFLAGS:-} -D warnings" CARGO_TARGET_DIR=$target/features \
            cargo check --release --lib --no-default-features --features "$features" || status=1
    done
    return $status
}

# Licences, sources and duplicates of the packages of all platforms, where cargo-deny is installed. Advisories
# are left to `cargo deny check advisories`, which fetches their database.
check_dependencies() {
    if ! command -v cargo-deny >/dev/null; then
        echo "SKIPPED cargo-deny: it is not installed. tests/dependencies.rs checks the licences on this platform"
        return
    fi
    cargo deny --workspace --locked check bans licenses sources
}

# The examples, as built above: each exits with an error where its result is wrong.
run_examples() {
    local folder=$target/examples-out
    rm -rf "$folder" && mkdir -p "$folder" &&
        "$target/release/examples/own_loss" "$folder/fitted.png" "$folder/fitted.ply" &&
        "$target/release/examples/render_ply" "$folder/fitted.ply" "$folder/view.png" &&
        "$target/release/examples/custom_kernel" "$folder/fog.png" &&
        "$target/release/examples/adopt_device" "$folder/adopted.png"
}

# The Python package with the library and the program that were built, without a wheel.
test_python() {
    local package=$target/python/splat4d
    rm -rf "$target/python"
    mkdir -p "$target/python"
    cp -r tools/python/python/splat4d "$target/python/" &&
        cp "$target/release/lib_splat4d.so" "$package/_splat4d.abi3.so" &&
        install -D "$target/release/splat4d" "$package/bin/splat4d" &&
        VK_DRIVER_FILES=$lavapipe PYTHONPATH=$target/python PYTHONDONTWRITEBYTECODE=1 \
            "$target/pytest/bin/python" -m pytest -p no:cacheprovider -ra --durations=3 tools/python/tests
}

# validate_subgroups N: the quick cases on lavapipe with subgroups of N. It makes them as wide as the
# processor's vectors, unless told otherwise.
validate_subgroups() {
    local program=$target/release/splat4d
    local -x VK_DRIVER_FILES=$lavapipe LP_NATIVE_VECTOR_WIDTH=$((32 * $1))
    "$program" devices | grep -F "subgroups of $1;" && "$program" validate --quick
}

test=(cargo test "${release[@]}" --no-fail-fast)
show=(-- --show-output)

step "format" cargo fmt --all --check -- --color never
step "build" cargo build "${release[@]}" --all-targets || {
    echo "tests FAILED: it does not build"
    exit 1
}
step "lints" cargo clippy "${release[@]}" --all-targets -- -D warnings
RUSTDOCFLAGS="-D warnings" step "docs" cargo doc "${release[@]}" --no-deps
step "features" check_features
step "dependencies" check_dependencies
step "newcomer" env VK_DRIVER_FILES="$lavapipe" tools/newcomer.sh
step "shaders" "$target/release/tools" check
step "modules" validate_modules
step "C header" "$target/release/header" check
step "unit tests" on "$lavapipe" "${test[@]}" --lib --bins "${others[@]}" "${show[@]}"
step "Python" test_python
step "wgpu host" on "$lavapipe" "$target/release/wgpu-host" --validation
step "wgpu host on SwiftShader" on "$swiftshader" "$target/release/wgpu-host" --validation --frames 20
step "examples" on "$lavapipe" run_examples
step "doc tests" on "$lavapipe" "${test[@]}" --doc
step "kernels on lavapipe" on "$lavapipe" "${test[@]}" "${kernel_tests[@]}" "${show[@]}"
step "subgroups of 4 on lavapipe" validate_subgroups 4
if grep -qw avx512f /proc/cpuinfo; then
    step "subgroups of 16 on lavapipe" validate_subgroups 16
fi
step "kernels on SwiftShader" on "$swiftshader" "${test[@]}" "${kernel_tests[@]}" "${show[@]}"
if ((${#end_to_end[@]})); then
    # Without the layer, and so on every core: it slows long runs down, and each kernel has passed under
    # it above. What runs in a process of its own may ask for it.
    step "end to end" env VK_DRIVER_FILES="$lavapipe" "${test[@]}" "${end_to_end[@]}" "${show[@]}"
fi

# The ONNX Runtime that the setup installs.
runtime=$(compgen -G "$target/onnxruntime/lib/python*/site-packages/onnxruntime/capi/libonnxruntime.so*" | head -n 1)
step "command line fuzz" env VK_DRIVER_FILES="$lavapipe" ORT_DYLIB_PATH="$runtime" "$target/release/cli-fuzz" \
    --program "$target/release/splat4d" --commands 250 --keep "$logs/cli-fuzz"

passed=$(cat "$logs"/*.log | awk '/^test result:/ { sum += $4 } END { print sum + 0 }')
skipped=$(cat "$logs"/*.log | grep -c '^SKIPPED')
if ((skipped)); then
    echo "== skipped:"
    cat "$logs"/*.log | grep '^SKIPPED' | sort | uniq -c
fi
summary="$passed tests passed, $skipped skipped something, $((SECONDS / 60)) min $((SECONDS % 60)) s"
if ((${#failed[@]})); then
    echo "tests FAILED: $(printf '%s; ' "${failed[@]}")$summary"
    exit 1
fi
echo "tests passed: $summary"
