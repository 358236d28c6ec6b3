"""The package and the command line give the same bits, on real data."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import splat4d
from conftest import assert_shown, command_line


def shared_data(name):
    """A path in the real data. A test without it is skipped, and fails with `SPLAT4D_REQUIRE_DATA=1`."""
    beside = Path(__file__).parents[3] / "../shared/data"
    path = Path(os.environ.get("SPLAT4D_DATA", beside)) / name
    if not path.exists():
        assert os.environ.get("SPLAT4D_REQUIRE_DATA") != "1", f"{path} is absent"
        pytest.skip(f"no shared data: {path}")
    return path


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
