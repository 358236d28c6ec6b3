"""`splat4d.rasterization` against a reference in float64, written from the mathematics of Gaussian splatting: EWA
projection, and front-to-back blending with the thresholds of the method. Gradients are compared with central
differences of the reference."""

import numpy as np
import pytest

import splat4d

WIDTH, HEIGHT, COUNT = 64, 48, 40
NEAR, EPS2D, ALPHA_CUT, ALPHA_CAP, STOP = 0.01, 0.3, 1 / 255, 0.999, 1e-4
# Gaussians whose parameters are varied one by one.
VARIED = range(0, COUNT, 8)
# So small that no pixel reaches or leaves a splat within a step: gradients do not include that.
STEP = 1e-8


def scene(sh_degree=None, channels=3, seed=0):
    """Gaussians around the origin, and two cameras that see all of them: quats, not normalised, and intrinsics with
    an off-centre principal point."""
    random = np.random.default_rng(seed)
    views = []
    for centre in ([0.6, -0.5, -4.0], [-0.9, 0.3, -3.6]):
        z = -np.array(centre) / np.linalg.norm(centre)
        x = np.cross([0, 1, 0], z) / np.linalg.norm(np.cross([0, 1, 0], z))
        view = np.eye(4)
        view[:3, :3] = [x, np.cross(z, x), z]
        view[:3, 3] = -view[:3, :3] @ centre
        views.append(view)
    k = [[[70.0, 0, 30.0], [0, 68.0, 25.0], [0, 0, 1]], [[60.0, 0, 33.5], [0, 61.0, 23.0], [0, 0, 1]]]
    sh = None if sh_degree is None else (COUNT, (sh_degree + 1) ** 2, channels)
    return {
        "means": random.uniform([-1.2, -0.9, -0.8], [1.2, 0.9, 0.8], size=(COUNT, 3)),
        "quats": random.normal(size=(COUNT, 4)),
        "scales": np.exp(random.uniform(-3.0, -1.2, size=(COUNT, 3))),
        "opacities": random.uniform(0.1, 0.95, size=COUNT),
        "colors": random.uniform(0, 1, (COUNT, channels)) if sh is None else random.uniform(-0.4, 0.4, sh),
        "viewmats": np.array(views),
        "Ks": np.array(k),
    }


def rounded(arrays):
    """The numbers that float32 holds, so that rounding of the input is no difference."""
    return {
        name: value if name in ("viewmats", "Ks") else value.astype(np.float32).astype(np.float64)
        for name, value in arrays.items()
    }


def rotations(quats):
    """Rotation matrices of unit quaternions."""
    w, x, y, z = quats.T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def basis(d):
    """Real spherical harmonics up to degree 3 with the signs of 3D Gaussian Splatting; shape (N, 16)."""
    x, y, z = d.T
    c1 = np.sqrt(3 / (4 * np.pi))
    c2 = np.sqrt(15 / (4 * np.pi))
    c3 = [np.sqrt(v / np.pi) for v in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)]
    return np.stack(
        [
            np.full_like(x, 0.5 / np.sqrt(np.pi)),
            -c1 * y,
            c1 * z,
            -c1 * x,
            c2 * x * y,
            -c2 * y * z,
            0.5 * c2 / np.sqrt(3) * (3 * z * z - 1),
            -c2 * x * z,
            0.5 * c2 * (x * x - y * y),
            -c3[0] * y * (3 * x * x - y * y),
            c3[1] * x * y * z,
            -c3[2] * y * (5 * z * z - 1),
            c3[3] * z * (5 * z * z - 3),
            -c3[2] * x * (5 * z * z - 1),
            c3[4] * z * (x * x - y * y),
            -c3[0] * x * (x * x - 3 * y * y),
        ],
        axis=-1,
    )


def reference(means, quats, scales, opacities, colors, viewmats, Ks, sh_degree=None):
    """Colours, alphas and depths: (C, H, W, 3), (C, H, W, 1), (C, H, W, 1)."""
    columns, rows = np.arange(WIDTH) + 0.5, np.arange(HEIGHT)[:, None] + 0.5
    frames = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True)) * scales[:, None]
    images = []
    for view, k in zip(viewmats, Ks):
        rotation, focal, centre = view[:3, :3], np.diag(k)[:2], k[:2, 2]
        points = means @ rotation.T + view[:3, 3]
        depths = points[:, 2]
        # The Jacobian is taken inside the field of view and a margin of 0.3 of half of it on each side.
        margin = 0.3 * 0.5 * np.array([WIDTH, HEIGHT]) / focal
        tangents = points[:, :2] / depths[:, None]
        low, high = -centre / focal - margin, ([WIDTH, HEIGHT] - centre) / focal + margin
        clamped = np.clip(tangents, low, high)
        jacobians = np.zeros((len(means), 2, 3))
        jacobians[:, 0, 0], jacobians[:, 1, 1] = (focal / depths[:, None]).T
        jacobians[:, :, 2] = -focal * clamped / depths[:, None]
        half = jacobians @ rotation @ frames
        inverses = np.linalg.inv(half @ half.transpose(0, 2, 1) + EPS2D * np.eye(2))
        x, y = (tangents * focal + centre).T[:, :, None, None]
        xx, xy, yy = inverses[:, [0, 0, 1], [0, 1, 1]].T[:, :, None, None]
        x, y = columns - x, rows - y
        sigmas = 0.5 * (xx * x * x + yy * y * y) + xy * x * y
        alphas = np.minimum(opacities[:, None, None] * np.exp(-sigmas), ALPHA_CAP)
        alphas[(alphas < ALPHA_CUT) | (depths < NEAR)[:, None, None]] = 0
        rgb = colors
        if sh_degree is not None:
            sight = means + rotation.T @ view[:3, 3]
            sight /= np.linalg.norm(sight, axis=1, keepdims=True)
            rgb = np.einsum("nk,nkc->nc", basis(sight)[:, : (sh_degree + 1) ** 2], colors)
            rgb = np.maximum(rgb + 0.5, 0)
        order = np.argsort(depths)
        alphas, shown = alphas[order], np.column_stack([rgb, np.ones(len(means)), depths])[order]
        after = np.cumprod(1 - alphas, axis=0)
        before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
        weights = np.where(after > STOP, before * alphas, 0)
        images.append(np.tensordot(weights, shown, (0, 0)))
    images = np.array(images)
    return images[..., :-2], images[..., -2:-1], images[..., -1:]


def relative(found, truth):
    """The largest difference, as a share of the largest true value."""
    return np.abs(found - truth).max() / max(np.abs(truth).max(), 1e-30)


def rigid(axis, step):
    """A motion of the camera: along an axis for 0 to 2, around one for 3 to 5."""
    motion = np.eye(4)
    if axis < 3:
        motion[axis, 3] = step
    else:
        i, j = [(1, 2), (2, 0), (0, 1)][axis - 3]
        motion[i, i] = motion[j, j] = np.cos(step)
        motion[j, i] = np.sin(step)
        motion[i, j] = -motion[j, i]
    return motion


def check_gradients(arrays, gradients, loss):
    """Compares gradients with central differences of `loss`."""

    def slope(name, change):
        either = [loss({**arrays, name: change(arrays[name].copy(), h)}) for h in (STEP, -STEP)]
        return (either[0] - either[1]) / (2 * STEP)

    for name in ("means", "quats", "scales", "opacities", "colors"):
        truth, found = [], []
        for i in VARIED:
            for at in np.ndindex(arrays[name].shape[1:]):

                def change(value, h):
                    value[(i, *at)] += h
                    return value

                truth.append(slope(name, change))
                found.append(gradients[name][(i, *at)])
        assert gradients[name].shape == arrays[name].shape and gradients[name].dtype == np.float32
        assert relative(np.array(found), np.array(truth)) < 1e-3, name
    truth, found = [], []
    for camera in range(2):
        for axis in range(6):

            def change(value, h):
                value[camera] = rigid(axis, h) @ value[camera]
                return value

            truth.append(slope("viewmats", change))
            along = (change(arrays["viewmats"].copy(), STEP) - arrays["viewmats"]) / STEP
            found.append((gradients["viewmats"] * along).sum())
    assert relative(np.array(found), np.array(truth)) < 1e-3, "viewmats"


@pytest.mark.parametrize("sh_degree", [None, 1, 3])
def test_image_and_gradients_are_those_of_the_reference(device, sh_degree):
    arrays = rounded(scene(sh_degree))
    backgrounds = np.array([[0.2, 0.5, 0.9], [1.0, 0.0, 0.3]])
    images, alphas, meta = splat4d.rasterization(
        **arrays,
        width=WIDTH,
        height=HEIGHT,
        sh_degree=sh_degree,
        backgrounds=backgrounds,
        device=device,
    )
    assert images.shape == (2, HEIGHT, WIDTH, 3) and alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (WIDTH, HEIGHT, 2)

    def truth(arrays):
        rgb, alpha, _ = reference(**arrays, sh_degree=sh_degree)
        return rgb + (1 - alpha) * backgrounds[:, None, None], alpha

    true_images, true_alphas = truth(arrays)
    assert np.abs(images - true_images).max() < 1e-4
    assert np.abs(alphas - true_alphas).max() < 1e-4
    assert true_alphas.max() > 0.9 and (true_alphas == 0).any()

    random = np.random.default_rng(1)
    v_images, v_alphas = random.normal(size=images.shape), random.normal(size=alphas.shape)

    def loss(arrays):
        images, alphas = truth(arrays)
        return (images * v_images).sum() + (alphas * v_alphas).sum()

    gradients = meta["backward"](v_images, v_alphas)
    check_gradients(arrays, gradients, loss)
    by_backgrounds = (v_images * (1 - true_alphas)).sum(axis=(1, 2))
    assert relative(gradients["backgrounds"], by_backgrounds) < 1e-3
    # The function does not use anything up.
    again = meta["backward"](v_images, v_alphas)
    assert all((again[name] == value).all() for name, value in gradients.items())


def test_depth_modes_and_negative_colours(device):
    arrays = rounded(scene())
    arrays["colors"] = arrays["colors"] - 0.5
    size = {"width": WIDTH, "height": HEIGHT, "device": device}
    rgb, alpha, depth = reference(**arrays)
    mean = depth / np.maximum(alpha, 1e-10)
    modes = {"RGB": [rgb], "D": [depth], "ED": [mean], "RGB+D": [rgb, depth], "RGB+ED": [rgb, mean]}
    for mode, parts in modes.items():
        images = splat4d.rasterization(**arrays, render_mode=mode, **size)[0]
        assert np.abs(images - np.concatenate(parts, axis=-1)).max() < 1e-4, mode
    random = np.random.default_rng(2)
    for mode in ("RGB+D", "ED"):
        images, _, meta = splat4d.rasterization(**arrays, render_mode=mode, **size)
        v_images = random.normal(size=images.shape)

        def loss(arrays):
            rgb, alpha, depth = reference(**arrays)
            mean = depth / np.maximum(alpha, 1e-10)
            shown = np.concatenate([rgb, depth], axis=-1) if mode == "RGB+D" else mean
            return (shown * v_images).sum()

        gradients = meta["backward"](v_images)
        check_gradients(arrays, gradients, loss)


def test_opacities_at_both_ends_have_gradients(device):
    arrays = rounded(scene())
    arrays["opacities"][:20] = 1
    arrays["opacities"][20:24] = 0
    images, _, meta = splat4d.rasterization(**arrays, width=WIDTH, height=HEIGHT, device=device)
    assert np.abs(images - reference(**arrays)[0]).max() < 1e-4
    found = meta["backward"](np.ones_like(images))["opacities"]

    def loss(opacity):
        changed = arrays["opacities"].copy()
        changed[:20] *= opacity
        return reference(**{**arrays, "opacities": changed})[0].sum()

    assert relative(found[:20].sum(), (loss(1) - loss(1 - STEP)) / STEP) < 0.02
    assert not found[20:24].any()


def test_each_camera_may_have_its_own_colours(device):
    arrays = rounded(scene())
    size = {"width": WIDTH, "height": HEIGHT, "device": device}
    both = np.stack([arrays["colors"], arrays["colors"][::-1]])
    images, _, meta = splat4d.rasterization(**{**arrays, "colors": both}, **size)
    gradients = meta["backward"](np.ones_like(images))
    assert gradients["colors"].shape == both.shape
    for i in range(2):
        one = {**arrays, "colors": both[i]}
        assert (splat4d.rasterization(**one, **size)[0][i] == images[i]).all()
        assert gradients["colors"][i].any()


@pytest.mark.parametrize("change, name", [
    ({"means": np.zeros((3, 2))}, "means"),
    ({"means": np.zeros((0, 3))}, "means"),
    ({"opacities": np.zeros((COUNT, 1))}, "opacities"),
    ({"opacities": np.full(COUNT, 1.5)}, "opacities"),
    ({"scales": np.zeros((COUNT, 3))}, "scales"),
    ({"colors": np.zeros((COUNT, 5))}, "colors"),
    ({"colors": np.zeros((COUNT, 3, 3)), "sh_degree": 1}, "colors"),
    ({"sh_degree": 4}, "sh_degree"),
    ({"Ks": np.tile([[50.0, 1, 32], [0, 50, 24], [0, 0, 1]], (2, 1, 1))}, "Ks"),
    ({"packed": True}, "packed"),
    ({"radius_clip": 2.0}, "radius_clip"),
    ({"far_plane": 4.0}, "far_plane"),
    ({"render_mode": "normal"}, "render_mode"),
    ({"rasterize_mode": "antialiased"}, "rasterize_mode"),
    ({"camera_model": "fisheye"}, "camera_model"),
    ({"covars": np.zeros((COUNT, 3, 3))}, "covars"),
])
def test_what_is_not_supported_is_said(device, change, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        splat4d.rasterization(
            **{**scene(), "width": WIDTH, "height": HEIGHT, "device": device, **change}
        )
    with pytest.raises(TypeError, match="colour"):
        splat4d.rasterization(**scene(), width=WIDTH, height=HEIGHT, colour=1, device=device)
