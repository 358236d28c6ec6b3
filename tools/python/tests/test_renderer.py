"""Tests of rendered images, against values computed here."""

import threading
import time

import numpy as np
import pytest

import splat4d
from conftest import SH_C0, gaussians, moving_arrays


def splat(depth, scale, opacity, colour):
    """Arrays of one isotropic Gaussian on the optical axis."""
    return {
        "positions": [[0, 0, depth]],
        "log_scales": [[np.log(scale)] * 3],
        "rotations": [[1, 0, 0, 0]],
        "opacity_logits": [np.log(opacity / (1 - opacity))],
        "sh": (np.array(colour).reshape(1, 1, 3) - 0.5) / SH_C0,
    }


def test_one_splat_is_a_gaussian_in_the_picture(device, camera):
    scene = splat4d.Scene(**splat(2.0, 0.1, 0.7, [0.9, 0.4, 0.1]))
    rendered = splat4d.Renderer(device, scene).render(camera)
    assert rendered.rgba.shape == (49, 65, 4) and rendered.depth.shape == (49, 65)
    assert rendered.rgba.dtype == rendered.depth.dtype == np.float32
    # On the axis the projection is a scaling by f / z; 0.3 square pixels are added.
    variance = (60.0 * 0.1 / 2.0) ** 2 + 0.3
    offsets = np.arange(-4, 5)
    squares = offsets[None, :] ** 2 + offsets[:, None] ** 2
    alpha = 0.7 * np.exp(-squares / (2 * variance))
    window = (slice(20, 29), slice(28, 37))
    np.testing.assert_allclose(rendered.rgba[window][..., 3], alpha, rtol=2e-3)
    colour = alpha[..., None] * [0.9, 0.4, 0.1]
    np.testing.assert_allclose(rendered.rgba[window][..., :3], colour, rtol=2e-3)
    np.testing.assert_allclose(rendered.depth[window], 2 * alpha, rtol=2e-3)
    np.testing.assert_allclose(rendered.mean_depth()[window], 2, rtol=1e-5)
    over = rendered.over((0.2, 0.3, 0.4))
    expected = rendered.rgba[..., :3] + (1 - rendered.rgba[..., 3:]) * np.float32([0.2, 0.3, 0.4])
    np.testing.assert_allclose(over, expected, atol=1e-7)


def test_the_nearer_splat_hides_the_farther(device, camera):
    near, far = splat(2.0, 0.1, 0.6, [1, 0, 0]), splat(4.0, 0.2, 0.5, [0, 1, 0])
    both = {name: np.concatenate([far[name], near[name]]) for name in near}
    rendered = splat4d.Renderer(device, splat4d.Scene(**both)).render(camera)
    np.testing.assert_allclose(rendered.rgba[24, 32], [0.6, 0.4 * 0.5, 0, 0.8], atol=1e-5)
    np.testing.assert_allclose(rendered.depth[24, 32], 0.6 * 2 + 0.4 * 0.5 * 4, rtol=1e-5)


def test_a_moving_splat_follows_its_path(device, camera):
    renderer = splat4d.Renderer(device, splat4d.Scene(**moving_arrays()))
    for at, column in ((0.0, 32), (1.0, 44)):
        alpha = renderer.render(camera, at).rgba[..., 3]
        # The path's end is at x = 0.4: 60 · 0.4 / 2 pixels to the right.
        assert np.unravel_index(alpha.argmax(), alpha.shape) == (24, column)
        np.testing.assert_allclose(renderer.moving(camera, at), alpha, atol=1e-6)
    with pytest.raises(splat4d.Error, match="nan|NaN"):
        renderer.render(camera, float("nan"))


def test_a_flat_splat_shows_its_normal(device, camera):
    arrays = splat(2.0, 0.2, 0.9, [1, 1, 1])
    arrays["log_scales"] = np.log([[0.2, 0.2, 0.001]])
    renderer = splat4d.Renderer(device, splat4d.Scene(**arrays))
    normals = renderer.normals(camera)
    np.testing.assert_allclose(normals[24, 32], [0, 0, -1], atol=1e-5)
    np.testing.assert_array_equal(normals[0, 0], [0, 0, 0])
    assert len(renderer) == 1


def test_the_same_scene_gives_the_same_bits(device, camera):
    scene = splat4d.Scene(**gaussians(500, degree=3))
    pictures = [splat4d.Renderer(device, scene).render(camera) for _ in range(2)]
    assert pictures[0].rgba.tobytes() == pictures[1].rgba.tobytes()
    assert pictures[0].depth.tobytes() == pictures[1].depth.tobytes()
    assert pictures[0].rgba[..., 3].max() > 0.5


def test_other_threads_run_during_a_long_call(device):
    renderer = splat4d.Renderer(device, splat4d.Scene(**gaussians(20000, degree=3)))
    large = splat4d.Camera(1440, 1080, fx=1350.0)
    renderer.render(large)
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    begin = time.perf_counter()
    renderer.render(large)
    end = time.perf_counter()
    done.set()
    thread.join()
    assert end - begin > 0.02, "the call is too short to tell"
    # If the call held the GIL, the other thread would not run during it.
    tenth = 0.1 * (end - begin)
    assert sum(begin + tenth < at < end - tenth for at in ticks) >= 3


def test_threads_share_a_renderer(device, camera):
    renderer = splat4d.Renderer(device, splat4d.Scene(**gaussians(200)))
    alone = renderer.render(camera).rgba
    found = []

    def render():
        found.extend(renderer.render(camera).rgba for _ in range(5))

    threads = [threading.Thread(target=render) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 15 and all(np.array_equal(alone, other) for other in found)


def test_devices_are_listed_and_found_by_name(device):
    found = splat4d.Device.list()
    assert device.name in [info.name for info in found]
    info = device.info
    assert info.kind == "software" and info.driver and info.memory_bytes > 0
    assert splat4d.Device(str(info.index)).name == device.name
    assert splat4d.Device(device.name[:6].upper()).name == device.name
    with pytest.raises(splat4d.Error, match="no device fits"):
        splat4d.Device("no such device")
