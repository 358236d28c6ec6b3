"""Single operations: their values against NumPy, their gradients against central differences."""

import numpy as np
import pytest

import splat4d
from conftest import gaussians
from splat4d import ops


class OnlyDlpack:
    """An array of another library, which has DLPack and no `__array__`."""

    def __init__(self, array):
        self.array = np.ascontiguousarray(array)

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


def along(function, value, direction, step):
    """The central difference of a function along a direction."""
    return (function(value + step * direction) - function(value - step * direction)) / (2 * step)


def unit(random, shape):
    direction = random.normal(size=shape)
    return direction / np.linalg.norm(direction)


def pictures(height=23, width=31):
    """A rendered image and an image to compare it with, whose colours differ by more than the steps of the tests."""
    random = np.random.default_rng(4)
    image = random.uniform(0.2, 0.8, size=(height, width, 3))
    image = np.round(image * 255) / 255
    alpha = random.uniform(0.3, 1, size=(height, width, 1))
    away = random.choice([-0.1, 0.1], size=image.shape) * random.uniform(0.5, 1, size=image.shape)
    return np.concatenate([image + away, alpha], axis=-1), image, random


def windowed(channel):
    """The mean in Gaussian windows of 11 × 11 pixels; outside of the image there is 0."""
    kernel = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
    kernel /= kernel.sum()
    for axis in (0, 1):
        channel = np.apply_along_axis(np.convolve, axis, channel, kernel, "same")
    return channel


def own_loss(rgba, image, weights, background, share):
    x, y = rgba[..., :3] + (1 - rgba[..., 3:]) * background, image
    ssim = np.empty(image.shape)
    for c in range(3):
        mx, my = windowed(x[..., c]), windowed(y[..., c])
        squares = windowed(x[..., c] ** 2 + y[..., c] ** 2) - mx**2 - my**2
        mixed = windowed(x[..., c] * y[..., c]) - mx * my
        above = (2 * mx * my + 0.01**2) * (2 * mixed + 0.03**2)
        ssim[..., c] = above / ((mx**2 + my**2 + 0.01**2) * (squares + 0.03**2))
    terms = (1 - share) * np.abs(x - y) + share * (1 - ssim)
    return (terms * weights[..., None]).sum() / (3 * weights.sum())


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_the_loss_and_its_gradient(device, share):
    rgba, image, random = pictures()
    weights = np.round(random.uniform(0, 1, size=image.shape[:2]) * 255) / 255
    background = np.array([0.1, 0.5, 0.9])
    rgba[..., :3] -= (1 - rgba[..., 3:]) * background

    def loss(rgba):
        return own_loss(np.float64(np.float32(rgba)), image, weights, background, share)

    value, gradient = ops.loss(
        device, rgba, image, weights=weights, background=background, ssim_share=share
    )
    assert value == pytest.approx(loss(rgba), rel=2e-5)
    assert gradient.shape == rgba.shape and gradient.dtype == np.float32
    for _ in range(4):
        direction = unit(random, rgba.shape)
        found = (np.float64(gradient) * direction).sum()
        # The own loss is that of f64, so that the difference has its digits.
        difference = along(lambda at: own_loss(at, image, weights, background, share), rgba, direction, 1e-4)
        assert abs(found - difference) < 1e-4 * np.linalg.norm(gradient)


def test_the_loss_of_equal_pictures_and_of_no_weight_is_zero(device):
    rgba, image, _ = pictures()
    same = np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)
    value, _ = ops.loss(device, same, np.uint8(np.round(image * 255)))
    assert abs(value) < 1e-5
    value, gradient = ops.loss(device, rgba, image, weights=np.zeros(image.shape[:2]))
    assert value == 0 and not gradient.any()


def pose(n=40, m=6):
    arrays = gaussians(n, seed=5)
    random = np.random.default_rng(6)
    motions = 0.3 * random.normal(size=(m, 8))
    return {
        **{name: arrays[name] for name in ("positions", "rotations", "opacity_logits")},
        "control_positions": random.uniform([-1, -0.7, 2.5], [1, 0.7, 4.5], size=(m, 3)),
        "control_log_radii": random.uniform(-0.6, 0.2, size=m),
        "motions": motions,
    }, random


def test_a_scene_at_a_time_is_what_deform_gives(device, camera):
    inputs, _ = pose()
    n, m = len(inputs["positions"]), len(inputs["motions"])
    moved = ops.deform(device, **inputs)
    shared = {**gaussians(n, seed=5), **dict(zip(["positions", "rotations", "opacity_logits"], moved))}
    assert np.abs(moved[0] - inputs["positions"]).max() > 0.1
    still = splat4d.Renderer(device, splat4d.Scene(**shared)).render(camera)
    control = {name: inputs[name] for name in ("control_positions", "control_log_radii")}
    moving = splat4d.Scene(
        **{**gaussians(n, seed=5), **control, "motion_logits": np.full(n, 20.0)},
        control_paths=np.stack([np.zeros((m, 8)), inputs["motions"]]),
    )
    rendered = splat4d.Renderer(device, moving).render(camera, 1.0)
    np.testing.assert_allclose(rendered.rgba, still.rgba, atol=1e-4)


@pytest.mark.parametrize("name, neighbours", [
    ("positions", 1), ("rotations", 4), ("control_log_radii", 4), ("motions", 4),
])
def test_the_gradients_of_deform(device, name, neighbours):
    """Each input but the positions, on whose weights the gradient does not depend, with several neighbours."""
    inputs, random = pose()
    by_positions = random.normal(size=inputs["positions"].shape)
    by_rotations = random.normal(size=inputs["rotations"].shape)

    def loss(value):
        positions, rotations, _ = ops.deform(device, **{**inputs, name: value}, neighbours=neighbours)
        return (np.float64(positions) * by_positions).sum() + (np.float64(rotations) * by_rotations).sum()

    found = ops.deform_backward(device, by_positions, by_rotations, **inputs, neighbours=neighbours)
    gradient = np.float64(found[name])
    assert gradient.shape == inputs[name].shape
    if name == "motions":
        assert not gradient[:, 3].any(), "the opacity offset has no gradient"
    for _ in range(3):
        direction = unit(random, gradient.shape)
        if name == "rotations":
            # The length of a quaternion has no effect on the gradient along its sphere.
            own = inputs[name]
            direction -= (direction * own).sum(-1, keepdims=True) * own
        difference = along(loss, inputs[name], direction, 1e-2)
        assert np.linalg.norm(gradient) > 0.1
        assert abs((gradient * direction).sum() - difference) < 2e-3 * np.linalg.norm(gradient), name


def test_opacities_move_by_the_offsets_of_their_control_points(device):
    inputs, _ = pose(m=1)
    inputs["motions"][0, 3] = -2.5
    moved = ops.deform(device, **inputs, neighbours=1)[2]
    np.testing.assert_allclose(moved, inputs["opacity_logits"] - 2.5, atol=1e-5)


def test_steps_of_adam_are_those_of_the_formula(device):
    random = np.random.default_rng(8)
    parameters, first, second = random.normal(size=(4, 5, 2)), np.zeros((4, 5, 2)), np.zeros((4, 5, 2))
    expected = parameters.copy()
    m, v = first.copy(), second.copy()
    rate, beta1, beta2, epsilon = 0.02, 0.8, 0.95, 1e-8
    for step in (1, 2, 3):
        gradients = random.normal(size=parameters.shape)
        parameters, first, second = ops.adam(
            device, parameters, gradients, first, second,
            step=step, rate=rate, beta1=beta1, beta2=beta2, epsilon=epsilon,
        )
        m, v = beta1 * m + (1 - beta1) * gradients, beta2 * v + (1 - beta2) * gradients**2
        unbiased = m / (1 - beta1**step), v / (1 - beta2**step)
        expected -= rate * unbiased[0] / (np.sqrt(unbiased[1]) + epsilon)
        for found, own in ((parameters, expected), (first, m), (second, v)):
            assert found.shape == own.shape and found.dtype == np.float32
            np.testing.assert_allclose(found, own, rtol=1e-5, atol=1e-6)


def test_adam_finds_a_minimum_along_the_gradient_of_the_loss(device):
    rgba, image, _ = pictures()
    rgba = np.float32(rgba)
    first, second = np.zeros_like(rgba), np.zeros_like(rgba)
    values = []
    for step in range(1, 31):
        value, gradient = ops.loss(device, rgba, image)
        rgba, first, second = ops.adam(device, rgba, gradient, first, second, step=step, rate=0.01)
        values.append(value)
    assert values[-1] < 0.2 * values[0]


def test_a_gradient_that_is_not_a_number_changes_nothing(device):
    zeros = np.zeros(2)
    parameters, first, _ = ops.adam(device, [1.0, 1.0], [np.nan, 2.0], zeros, zeros, step=1, rate=0.1)
    np.testing.assert_allclose(parameters, [1, 0.9], atol=1e-6)
    assert first[0] == 0 and first[1] > 0


@pytest.mark.parametrize("count", [0, 1, 257, 5000])
def test_a_sort_is_stable_and_its_payload_the_order(device, count):
    keys = np.random.default_rng(count).integers(0, 2**32, size=count, dtype=np.uint32) & 0x80000f0f
    order = np.argsort(keys, kind="stable")
    sorted_keys, payload = ops.sort(device, keys)
    assert sorted_keys.dtype == payload.dtype == np.uint32
    np.testing.assert_array_equal(sorted_keys, keys[order])
    np.testing.assert_array_equal(payload, order)
    # By some bits only, with a payload of one's own.
    order = np.argsort(keys >> 8 & 0xf, kind="stable")
    sorted_keys, payload = ops.sort(device, keys.astype(np.int64), 7 * np.arange(count), bits=(8, 12))
    np.testing.assert_array_equal(sorted_keys, keys[order])
    np.testing.assert_array_equal(payload, 7 * order)


def test_what_has_dlpack_alone_is_taken(device):
    keys = np.array([3, 1, 2])
    np.testing.assert_array_equal(ops.sort(device, OnlyDlpack(keys))[0], [1, 2, 3])
    rgba, image, _ = pictures()
    value, gradient = ops.loss(device, rgba, image)
    others = ops.loss(device, OnlyDlpack(rgba), OnlyDlpack(np.float32(image)))
    assert others[0] == value and np.array_equal(others[1], gradient)
    scene = splat4d.Scene(**{name: OnlyDlpack(value) for name, value in gaussians(3).items()})
    assert len(scene) == 3
    given = {
        "means": [[0.0, 0, 3]], "quats": [[1.0, 0, 0, 0]], "scales": [[0.2] * 3], "opacities": [0.5],
        "colors": [[1.0, 0, 0]], "viewmats": [np.eye(4)], "Ks": [[[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]],
    }
    plain = splat4d.rasterization(**given, width=16, height=12, device=device)[0]
    given = {name: OnlyDlpack(np.array(value)) for name, value in given.items()}
    assert np.array_equal(splat4d.rasterization(**given, width=16, height=12, device=device)[0], plain)


def test_wrong_arguments_are_refused(device):
    rgba, image, _ = pictures()
    inputs, _ = pose()
    with pytest.raises(ValueError, match=r"image: .* \(23, 31, 3\), got \(22, 31, 3\)"):
        ops.loss(device, rgba, image[1:])
    with pytest.raises(ValueError, match=r"rgba: .* \(height, width, 4\), got \(23, 31, 3\)"):
        ops.loss(device, image, image)
    with pytest.raises(splat4d.Error, match="ssim_share is 2.0"):
        ops.loss(device, rgba, image, ssim_share=2.0)
    with pytest.raises(splat4d.Error, match="0×0 pixels"):
        ops.loss(device, np.zeros((0, 0, 4)), np.zeros((0, 0, 3)))
    with pytest.raises(ValueError, match=r"motions: .* \(6, 8\), got \(5, 8\)"):
        ops.deform(device, **{**inputs, "motions": inputs["motions"][1:]})
    with pytest.raises(splat4d.Error, match="9 control points .* 1 to 8"):
        ops.deform(device, **inputs, neighbours=9)
    with pytest.raises(ValueError, match=r"grad_rotations: .* \(40, 4\), got \(40, 3\)"):
        ops.deform_backward(device, inputs["positions"], inputs["positions"], **inputs)
    with pytest.raises(ValueError, match=r"first: .* \(2,\), got \(3,\)"):
        ops.adam(device, [0, 0], [1, 1], [0, 0, 0], [0, 0], step=1)
    with pytest.raises(splat4d.Error, match="steps count from 1"):
        ops.adam(device, [0], [1], [0], [0], step=0)
    with pytest.raises(ValueError, match="keys: expected integers, got float64"):
        ops.sort(device, [0.5])
    with pytest.raises(ValueError, match=r"keys: -1 is not in \[0, 2³²\)"):
        ops.sort(device, [3, -1])
    with pytest.raises(splat4d.Error, match="bits within 0..32"):
        ops.sort(device, [1], bits=(0, 33))
