"""Tests of camera paths: the same as the command line's, and in their geometry."""

import numpy as np
import pytest

import splat4d
from conftest import assert_shown, command_line, gaussians, moving_arrays


def moving_scene(cameras=True):
    """A moving Gaussian before others that stand, seen by a camera that moves to the right."""
    arrays, others = moving_arrays(), gaussians(40)
    for name, rows in others.items():
        arrays[name] = np.concatenate([arrays[name], rows])
    arrays["motion_logits"] = [1] + 40 * [-1]
    scene = splat4d.Scene(**arrays)
    if cameras:
        poses = [np.eye(4) for _ in range(5)]
        for index, pose in enumerate(poses):
            pose[0, 3] = -0.1 * index
        known = [splat4d.Camera(64, 48, fx=50.0, view_from_world=pose) for pose in poses]
        scene.set_cameras(known, np.linspace(0, 1, 5))
    return scene


@pytest.mark.parametrize(
    "shape, keywords, options",
    [
        ("orbit", {}, []),
        ("orbit", {"size": (90, 48), "focal": 40.0}, ["--size=90x48", "--focal=40"]),
        ("spiral", {}, []),
        ("dolly", {}, []),
        ("bullet", {}, []),
        ("bullet", {"time": 0.25}, ["--times=0.25"]),
    ],
)
def test_a_path_is_rendered_to_the_bits_of_the_command_line(
    device, tmp_path, shape, keywords, options
):
    file, views = tmp_path / "scene.safetensors", tmp_path / "views"
    scene = moving_scene()
    scene.save(file)
    command_line("render", file, "-o", views, "--path", shape, "--frames=3", "--exr", *options)
    cameras, times = scene.camera_path(shape, frames=3, **keywords)
    assert len(cameras) == len(times) == len(list(views.glob("????.exr"))) == 3
    renderer = splat4d.Renderer(device, scene)
    for index, (camera, time) in enumerate(zip(cameras, times)):
        assert_shown(views, index, renderer.render(camera, time))


def test_a_scene_without_cameras_is_circled_as_the_command_line_does(device, tmp_path):
    file, views = tmp_path / "scene.safetensors", tmp_path / "views"
    scene = moving_scene(cameras=False)
    scene.save(file)
    command_line("render", file, "-o", views, "--frames=2", "--size=80x45", "--exr")
    cameras, times = scene.camera_path(frames=2, size=(80, 45))
    renderer = splat4d.Renderer(device, scene)
    for index, (camera, time) in enumerate(zip(cameras, times)):
        assert_shown(views, index, renderer.render(camera, time))
    plain, _ = scene.camera_path()
    assert len(plain) == 60 and (plain[0].width, plain[0].height) == (960, 540)


def test_paths_lead_where_they_say():
    scene = moving_scene()
    for shape in ("orbit", "spiral", "dolly"):
        cameras, times = scene.camera_path(shape, frames=5)
        np.testing.assert_array_equal(times, np.linspace(0, 1, 5))
        assert all((c.width, c.height, c.fx) == (64, 48, 50.0) for c in cameras)
    # Without the input's own motion, a dolly moves along the line of sight alone.
    poses = np.array([camera.view_from_world for camera in cameras])
    assert poses.shape == (5, 4, 4) and poses.dtype == np.float64
    centres = np.array([camera.centre for camera in cameras]) - [[0.1 * i, 0, 0] for i in range(5)]
    np.testing.assert_allclose(centres[:, :2], 0, atol=1e-12)
    assert (np.diff(centres[:, 2]) > 0.1).all()
    bullet, times = scene.camera_path("bullet", frames=5, time=0.25)
    assert (times == 0.25).all()
    assert np.ptp([camera.centre[0] for camera in bullet]) > 0.3


def test_wrong_paths_are_refused():
    scene = moving_scene()
    for shape, keywords, text in [
        ("circle", {}, "shape: .*circle"),
        ("orbit", {"frames": 0}, "frames: expected 1 to 1000000, got 0"),
        ("orbit", {"frames": 10**7}, "frames"),
        ("orbit", {"time": 0.5}, "time: .*bullet"),
    ]:
        with pytest.raises(ValueError, match=text):
            scene.camera_path(shape, **keywords)
    for keywords, text in [
        ({"time": 1.5}, "time 1.5 is not in"),
        ({"time": float("nan")}, "time NaN is not in"),
        ({"size": (0, 48)}, "camera 0 of the path cannot be rendered from: image width"),
        ({"focal": -1.0}, "focal length"),
    ]:
        with pytest.raises(splat4d.Error, match=text):
            scene.camera_path("bullet", **keywords)
