"""Tests of training with the engine's loss and with a loss computed by the caller."""

import os
import signal
import threading
import time
from collections.abc import Mapping

import numpy as np
import pytest

import splat4d
from conftest import gaussians, moving_arrays


def start(device, camera, **settings):
    """A trainer whose Gaussians differ a little from those that its training view shows."""
    arrays = gaussians(60)
    target = splat4d.Renderer(device, splat4d.Scene(**arrays)).render(camera).over()
    random = np.random.default_rng(3)
    arrays["sh"] = arrays["sh"] + 0.3 * random.normal(size=arrays["sh"].shape)
    scene = splat4d.Scene(**arrays)
    views = [splat4d.View(target, camera)]
    return splat4d.Trainer(device, scene, views, steps=40, growth=None, sh_degree=0, **settings)


def test_steps_bring_the_picture_closer(device, camera):
    trainer = start(device, camera)
    assert trainer.loss() is None and trainer.psnr() is None
    trainer.step()
    first, before = trainer.loss(), trainer.psnr()
    seen = []
    trainer.steps(39, progress=seen.append)
    assert trainer.loss()["l1"] < 0.5 * first["l1"]
    assert trainer.psnr() > before + 5
    assert seen[-1].step == trainer.progress.step == 40 and seen[-1].steps == 40
    assert all(a.step < b.step for a, b in zip(seen, seen[1:]))
    assert len(trainer.scene()) == seen[-1].gaussians == 60


def test_training_gives_the_same_bits_twice(device, camera):
    found = []
    for _ in range(2):
        trainer = start(device, camera)
        trainer.steps(15)
        found.append(trainer.scene().arrays())
    changed = gaussians(60)
    for name, value in found[0].items():
        assert value.tobytes() == found[1][name].tobytes(), name
    assert not np.array_equal(found[0]["positions"], np.float32(changed["positions"]))


def test_bytes_are_the_same_as_floats(device, camera):
    image = np.random.default_rng(5).integers(0, 256, size=(49, 65, 3), dtype=np.uint8)
    scene = splat4d.Scene(**gaussians(10))
    losses = []
    for picture in (image, image.astype(np.float32) / np.float32(255)):
        trainer = splat4d.Trainer(device, scene, [splat4d.View(picture, camera)], growth=None)
        trainer.step()
        losses.append(trainer.loss())
    assert losses[0] == losses[1] and losses[0]["l1"] > 0


@pytest.mark.parametrize("arrays, time, names", [
    (gaussians(4), 0.0, ["positions", "log_scales", "rotations", "opacity_logits", "sh"]),
    (moving_arrays(), 0.5, ["positions", "opacity_logits", "control_paths"]),
])
def test_gradients_are_those_of_central_differences(device, camera, arrays, time, names):
    """The loss is a fixed random weighting of colour, alpha and depth. A splat ends where its alpha falls below
    `alpha_cut`, and the gradients do not include the movement of that border: the cut is made small."""
    random = np.random.default_rng(7)
    by_rgba = random.normal(size=(49, 65, 4)).astype(np.float32)
    by_depth = random.normal(size=(49, 65)).astype(np.float32)
    arrays = {name: np.asarray(value, np.float32) for name, value in arrays.items()}

    def scene(changed):
        made = splat4d.Scene(**changed)
        made.set_blending(alpha_cut=1e-6)
        return made

    def loss(changed):
        rendered = splat4d.Renderer(device, scene(changed)).render(camera, time)
        rgba, depth = np.float64(rendered.rgba), np.float64(rendered.depth)
        return (rgba * by_rgba).sum() + (depth * by_depth).sum()

    trainer = splat4d.Trainer(
        device, scene(arrays), growth=None, sh_degree=0, sh_interval=0, rigidity_weight=0
    )
    trainer.forward(camera, time)
    gradients = trainer.backward(by_rgba, by_depth)
    for name in names:
        assert gradients[name].shape == arrays[name].shape
        # The difference is taken along a random direction, so that it checks all entries at once.
        direction = random.normal(size=arrays[name].shape).astype(np.float32)
        direction /= np.linalg.norm(direction)
        step = 2e-3
        ends = [loss({**arrays, name: arrays[name] + s * step * direction}) for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        along = (np.float64(gradients[name]) * direction).sum()
        scale = np.linalg.norm(gradients[name])
        assert scale > 0.1, name
        print(name, along, difference, scale)
        assert abs(along - difference) < 1e-3 * scale, (name, along, difference)


def test_an_own_loss_trains_as_far_as_it_is_updated(device, camera):
    scene = splat4d.Scene(**gaussians(60))
    target = splat4d.Renderer(device, splat4d.Scene(**gaussians(60, seed=9))).render(camera).rgba
    trainer = splat4d.Trainer(device, scene, steps=30, growth=None, sh_degree=0)
    losses = []
    for _ in range(30):
        error = trainer.forward(camera).rgba - target
        losses.append(float((error**2).sum()))
        trainer.backward(2 * error)
        trainer.update()
    assert losses[-1] < 0.7 * losses[0]
    assert trainer.progress.step == 30
    # Without `update` no parameter changes.
    arrays = trainer.scene().arrays()
    trainer.forward(camera)
    trainer.backward(np.ones((49, 65, 4)))
    again = trainer.forward(camera)
    assert trainer.progress.step == 30
    for name, value in trainer.scene().arrays().items():
        np.testing.assert_array_equal(value, arrays[name], name)
    rendered = splat4d.Renderer(device, trainer.scene()).render(camera)
    np.testing.assert_array_equal(rendered.rgba, again.rgba)


@pytest.mark.parametrize("arrays", [gaussians(60), moving_arrays()])
def test_what_is_read_late_has_the_same_bits(device, camera, arrays):
    """Depth and gradients are the same whether they are read at once, after `update`, after the next `forward`,
    or after the trainer is gone."""
    random = np.random.default_rng(2)
    by_rgba = random.normal(size=(49, 65, 4)).astype(np.float32)
    by_depth = random.normal(size=(49, 65)).astype(np.float32)

    def step(then):
        trainer = splat4d.Trainer(device, splat4d.Scene(**arrays), growth=None, sh_degree=0)
        rendered = trainer.forward(camera, 0.5)
        gradients = trainer.backward(by_rgba, by_depth)
        if then == "at once":
            return {"depth": rendered.depth, **gradients}
        if then == "some at once":
            assert gradients["pose"] is gradients["pose"] and rendered.depth is rendered.depth
        if then != "dropped":
            trainer.update()
        if then == "next":
            trainer.forward(camera, 0.1)
            trainer.backward(by_rgba)
        if then in ("dropped", "updated and dropped"):
            del trainer
        return {"depth": rendered.depth, **gradients}

    expected = step("at once")
    assert np.abs(expected["depth"]).max() > 0 and np.abs(expected["positions"]).max() > 0
    for then in ("some at once", "update", "next", "dropped", "updated and dropped"):
        found = step(then)
        assert list(found) == list(expected)
        for name, value in found.items():
            assert value.shape == expected[name].shape and value.dtype == np.float32
            assert value.tobytes() == expected[name].tobytes(), (then, name)


def test_gradients_are_a_mapping(device, camera):
    trainer = splat4d.Trainer(device, splat4d.Scene(**gaussians(5)), growth=None, sh_degree=0)
    trainer.forward(camera)
    gradients = trainer.backward(np.ones((49, 65, 4)))
    names = ["positions", "log_scales", "rotations", "opacity_logits", "sh", "pose"]
    assert isinstance(gradients, Mapping) and isinstance(gradients, splat4d.Gradients)
    assert list(gradients) == list(gradients.keys()) == names and len(gradients) == 6
    assert "pose" in gradients and "depth" not in gradients and gradients.get("depth") is None
    with pytest.raises(KeyError, match="depth"):
        gradients["depth"]
    assert [value.shape for value in gradients.values()] == [
        (5, 3), (5, 3), (5, 4), (5,), (5, 1, 3), (6,)
    ]
    assert "positions" in repr(gradients)


def test_many_large_splats_are_rendered_whole(device, camera):
    """The frame has more pairs of splats and tiles than the initial capacity."""
    arrays = gaussians(3000)
    arrays["log_scales"] = np.full((3000, 3), 0.5)
    arrays["opacity_logits"] = np.full(3000, -6.0)
    scene = splat4d.Scene(**arrays)
    large = splat4d.Camera(400, 300, fx=300.0)
    trainer = splat4d.Trainer(device, scene, growth=None, sh_degree=0)
    rendered = splat4d.Renderer(device, scene).render(large)
    np.testing.assert_array_equal(trainer.forward(large).rgba, rendered.rgba)


def test_steps_out_of_order_are_refused(device, camera):
    scene = splat4d.Scene(**gaussians(5))
    trainer = splat4d.Trainer(device, scene, growth=None)
    with pytest.raises(splat4d.Error, match="backward comes after forward"):
        trainer.backward(np.zeros((49, 65, 4)))
    with pytest.raises(splat4d.Error, match="`update` comes in the order"):
        trainer.update()
    with pytest.raises(splat4d.Error, match="there are none"):
        trainer.step()
    trainer.forward(camera)
    with pytest.raises(ValueError, match=r"grad_rgba: .* \(49, 65, 4\), got \(49, 65, 3\)"):
        trainer.backward(np.zeros((49, 65, 3)))


def test_wrong_settings_and_views_are_refused(device, camera):
    scene = splat4d.Scene(**gaussians(5, degree=2))
    with pytest.raises(TypeError, match='no setting "stepz"'):
        splat4d.Trainer(device, scene, stepz=3)
    with pytest.raises(ValueError, match='growth: expected "mcmc", "adaptive" or None'):
        splat4d.Trainer(device, scene, growth="fast")
    with pytest.raises(ValueError, match="sh_degree: expected at least the scene's 2, got 1"):
        splat4d.Trainer(device, scene, sh_degree=1)
    with pytest.raises(splat4d.Error, match="opacity_rate is NaN"):
        splat4d.Trainer(device, scene, opacity_rate=float("nan"))
    with pytest.raises(ValueError, match=r"image: .* \(49, 65, 3\), got \(65, 49, 3\)"):
        splat4d.View(np.zeros((65, 49, 3)), camera)
    with pytest.raises(ValueError, match=r"weights: .* \(49, 65\), got \(49, 64\)"):
        splat4d.View(np.zeros((49, 65, 3)), camera, weights=np.ones((49, 64)))


def test_ctrl_c_stops_the_steps(device, camera, ctrl_c):
    trainer = start(device, camera)

    def interrupt():
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        trainer.steps(1_000_000)
    assert time.perf_counter() - begin < 10
    thread.join()
    done = trainer.progress.step
    assert 0 < done < 1_000_000
    trainer.step()
    assert trainer.progress.step == done + 1


def test_an_exception_in_the_callback_stops_the_steps(device, camera):
    trainer = start(device, camera)

    def stop(progress):
        raise RuntimeError(f"enough after {progress.step}")

    with pytest.raises(RuntimeError, match="enough after"):
        trainer.steps(1_000_000, progress=stop)
    assert trainer.progress.step < 1_000_000
