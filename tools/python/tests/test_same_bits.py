"""The package and the command line give the same bits, on real data."""

import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

import splat4d


def shared_data(name):
    """A path in the real data. A test without it is skipped, and fails with `SPLAT4D_REQUIRE_DATA=1`."""
    beside = Path(__file__).parents[3] / "../shared/data"
    path = Path(os.environ.get("SPLAT4D_DATA", beside)) / name
    if not path.exists():
        assert os.environ.get("SPLAT4D_REQUIRE_DATA") != "1", f"{path} is absent"
        pytest.skip(f"no shared data: {path}")
    return path


def command_line(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "splat4d", "--device", "software", *map(str, arguments)],
        capture_output=True, text=True,
    )
    assert done.returncode == 0, done.stderr


def read_exr(path):
    """The channels of an OpenEXR file of 32-bit floats, by name: those that the program writes are compressed by
    zlib in blocks of 16 rows."""
    data = path.read_bytes()
    assert data[:8] == bytes.fromhex("762f310102000000"), "one part of scan lines"
    at, header = 8, {}
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        size = int.from_bytes(data[at : at + 4], "little")
        header[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    left, top, right, bottom = np.frombuffer(header["dataWindow"], "<i4")
    width, height, rows = right - left + 1, bottom - top + 1, 16
    assert header["compression"] == b"\3"
    # A channel: its name, its type, and 12 bytes of which float channels have no need.
    channels, listed = [], header["channels"]
    while listed[0]:
        name, listed = listed.split(b"\0", 1)
        assert listed[0] == 2, "floats"
        channels.append(name.decode())
        listed = listed[16:]
    lines = []
    offsets = np.frombuffer(data, "<u8", -(-height // rows), at + 1)
    for block, offset in enumerate(offsets):
        count = min(rows, height - rows * block)
        size = int.from_bytes(data[offset + 4 : offset + 8], "little")
        packed, length = data[offset + 8 : offset + 8 + size], 4 * width * count * len(channels)
        if size == length:
            plain = np.frombuffer(packed, np.uint8)
        else:
            # Each byte is stored as the difference from the one before it, first those at even places.
            steps = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
            steps[1:] -= 128
            halves = np.cumsum(steps).astype(np.uint8)
            plain = np.empty(length, np.uint8)
            plain[0::2], plain[1::2] = np.split(halves, [(length + 1) // 2])
        lines.append(plain.view("<f4").reshape(count, len(channels), width))
    return dict(zip(channels, np.concatenate(lines).transpose(1, 0, 2)))


def assert_shown(folder, index, rendered):
    """The folder's image has the bits of the rendered one."""
    channels = read_exr(folder / f"{index:04}.exr")
    found = np.stack([channels[name] for name in "RGBA"], axis=-1)
    assert found.shape == rendered.rgba.shape and found[..., 3].max() > 0.5
    assert found.tobytes() == rendered.rgba.tobytes()


def test_biker_is_rendered_to_the_bits_of_the_command_line(device, tmp_path):
    biker = shared_data("splats_playcanvas/biker.compressed.ply")
    scene = splat4d.Scene.open(biker)
    # Three cameras around it, at the corners of no grid.
    positions = scene.arrays()["positions"]
    centre, radius = np.median(positions, axis=0), np.ptp(positions, axis=0).max()
    frames = []
    for angle in (0.3, 1.9, 4.1):
        sin, cos = np.sin(angle), np.cos(angle)
        pose = np.eye(4)
        pose[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        pose[:3, 3] = centre + radius * pose[:3, 2]
        frames.append({"transform_matrix": pose.tolist()})
    path = tmp_path / "path.json"
    lens = {"fl_x": 200.0, "fl_y": 200.0, "cx": 120.0, "cy": 90.5, "w": 240, "h": 181}
    path.write_text(json.dumps({**lens, "frames": frames}))
    command_line("render", biker, "-o", tmp_path / "views", "--path", path, "--exr")

    cameras, times = splat4d.Camera.read(path)
    np.testing.assert_array_equal(times, [0, 0.5, 1])
    renderer = splat4d.Renderer(device, scene)
    for index, (camera, time) in enumerate(zip(cameras, times)):
        assert_shown(tmp_path / "views", index, renderer.render(camera, time))


def test_fox_is_trained_to_the_bits_of_the_command_line(device, tmp_path):
    fox = shared_data("fox270")
    file, others = tmp_path / "fox.safetensors", tmp_path / "others.safetensors"
    report = splat4d.train(
        fox, file, steps=30, size=120, sh_degree=1, device="software", progress=lambda line: None
    )
    command_line("train", fox, "-o", others, "--steps=30", "--size=120", "--sh-degree=1")
    assert file.read_bytes() == others.read_bytes()

    # What was trained is shown alike, too: by the input's cameras at their times.
    command_line("render", others, "-o", tmp_path / "views", "--exr")
    scene = splat4d.Scene.open(file)
    assert len(scene) == report["gaussians"] and len(scene.cameras) == report["images"] + report["held_out"]
    renderer = splat4d.Renderer(device, scene)
    for index in (0, len(scene.cameras) - 1):
        rendered = renderer.render(scene.cameras[index], scene.times[index])
        assert_shown(tmp_path / "views", index, rendered)
