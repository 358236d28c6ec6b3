#!/usr/bin/env bash
# One video in, a 4D scene out: installs what is missing, builds, reconstructs, renders.
#
#   tools/demo.sh            on a synthetic clip that it makes
#   tools/demo.sh VIDEO|DIR  on a video file, or on a folder of its frames
#
# Everything lands in out/demo, or in $OUT. A scene that is there already is made anew.
set -euo pipefail

if (($# > 1)) || [[ ${1:-} == -* ]]; then
    echo "usage: tools/demo.sh [VIDEO|DIR]" >&2
    exit 2
fi
# The caller's paths are relative to where the caller stands.
input=${1:+$(realpath -- "$1")}
if [[ -n $input && ! -e $input ]]; then
    echo "demo: $1: no such file or folder" >&2
    exit 1
fi
cd "$(dirname "$0")/.."
out=$(realpath -m -- "${OUT:-out/demo}")
splat4d=${CARGO_TARGET_DIR:-target}/release/splat4d

tools/setup.sh run
. tools/rust-path.sh
cargo build --release -p splat4d
mkdir -p "$out"
"$splat4d" devices

if [[ -z $input ]]; then
    echo "== a synthetic clip: one rigid mover before a static room"
    "$splat4d" synth rigid -o "$out/clip" --frames 24 --size 320x180
    input=$out/clip
fi

echo "== reconstruct $input"
# Small and short enough for two cores without a GPU; give the command itself more of all three.
"$splat4d" reconstruct "$input" -o "$out/scene.safetensors" --report "$out/report" \
    --size 320 --max-frames 40 --steps 1500 --max-gaussians 20000

echo "== novel views"
rm -rf "$out/novel" "$out/input"
"$splat4d" render "$out/scene.safetensors" -o "$out/novel" --path orbit
"$splat4d" render "$out/scene.safetensors" -o "$out/input" --path input

if [[ -d $input/truth ]]; then
    echo "== against the truth"
    "$splat4d" eval "$out/scene.safetensors" "$input/truth" | tee "$out/report/truth.txt"
fi

cat <<END

the scene          $out/scene.safetensors
novel views        $out/novel/*.png
the input's views  $out/input/*.png
side by side       $out/report/sheet.png   (input, render, motion mask, depth)
the report         $out/report/report.html

in the browser:    $splat4d view $out/scene.safetensors
more views:        $splat4d render $out/scene.safetensors -o DIR --path orbit
took $((SECONDS / 60)) min $((SECONDS % 60)) s
END
