"""Rendering with the interface of gsplat's `rasterization`, on NumPy arrays, with gradients."""

import functools

import numpy as np

from ._arrays import as_numpy
from ._splat4d import Camera, Device, Scene, Trainer

SH_C0 = 0.28209479177387814
# Distance that opacities keep from 0 and 1: the gradient is divided by opacity · (1 − opacity), which the device's
# floats do not resolve any nearer.
LEAST_OPACITY = 6e-6
# A colour that is not a spherical harmonic is kept above this by an offset, because the engine clamps at 0.
LEAST_COLOUR = 1 / 64
# The alpha by which depth is divided at least.
LEAST_ALPHA = 1e-10
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Further arguments of gsplat's function, and the only value that is supported.
FIXED = {
    "sparse_grad": False,
    "absgrad": False,
    "rasterize_mode": "classic",
    "distributed": False,
    "camera_model": "pinhole",
    "segmented": False,
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "viewmats_rs": None,
}


@functools.cache
def best_device():
    return Device("best")


def array(name, value, shape, dtype=np.float32):
    """A copy of the value as an array. A side of `shape` that is not a number is a name for messages and not
    checked."""
    value = np.array(as_numpy(value), dtype)
    fits = value.ndim == len(shape) and all(
        side == wanted for side, wanted in zip(value.shape, shape) if isinstance(wanted, int)
    )
    if not fits:
        expected = ", ".join(map(str, shape))
        raise ValueError(f"{name}: expected the shape ({expected}), got {value.shape}")
    return value


def check_options(packed, radius_clip, render_mode, others):
    if packed:
        raise ValueError("packed: only False is supported")
    if radius_clip != 0:
        raise ValueError(f"radius_clip: only 0 is supported, got {radius_clip}")
    if render_mode not in MODES:
        raise ValueError(f"render_mode: expected one of {', '.join(MODES)}, got {render_mode!r}")
    for name, value in others.items():
        if name not in FIXED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        only = FIXED[name]
        if value is not only and (only is None or value != only):
            raise ValueError(f"{name}: only {only!r} is supported")


def cameras_of(viewmats, intrinsics, width, height):
    for k in intrinsics:
        if k[0, 1] != 0 or k[1, 0] != 0 or (k[2] != [0, 0, 1]).any():
            raise ValueError(f"Ks: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}")
    return [
        Camera(width, height, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2], view_from_world=view)
        for view, k in zip(viewmats, intrinsics)
    ]


def viewmat_gradient(viewmat, pose):
    """The gradient with respect to a matrix [R t; 0 1], given that with respect to its left perturbation.

    `pose` holds the derivatives ∂τ and ∂ω along the rigid motion R → (1 + [ω]×) R, t → t + ω × t + τ. With
    a = ∂ω − t × ∂τ, ½ [a]× R for R and ∂τ for t give the same derivatives along every rigid motion, and 0 along
    every other change of R."""
    by_translation, by_rotation = pose[:3].astype(np.float64), pose[3:].astype(np.float64)
    x, y, z = by_rotation - np.cross(viewmat[:3, 3], by_translation)
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = 0.5 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ viewmat[:3, :3]
    gradient[:3, 3] = by_translation
    return gradient


def harmonics(colors, sh_degree, n, c):
    """The colours as the engine has them: coefficients of spherical harmonics, and what was added to the colours.
    Also the array itself, and whether each camera has colours of its own."""
    if sh_degree is not None and sh_degree not in range(4):
        raise ValueError(f"sh_degree: expected None or 0 to 3, got {sh_degree}")
    shape = (n, 3) if sh_degree is None else (n, "K", 3)
    colors = np.asarray(as_numpy(colors), np.float32)
    per_camera = colors.ndim > len(shape)
    colors = array("colors", colors, (c, *shape) if per_camera else shape)
    if sh_degree is None:
        offset = np.float32(max(0.0, LEAST_COLOUR - colors.min(initial=1)))
        return ((colors + offset - 0.5) / SH_C0)[..., None, :], offset, colors, per_camera
    used = (sh_degree + 1) ** 2
    if colors.shape[-2] < used:
        raise ValueError(f"colors: degree {sh_degree} has {used} coefficients, got {colors.shape[-2]}")
    return colors[..., :used, :], np.float32(0), colors, per_camera


class Pixels:
    """Rendered images of C cameras, and how the result is made of them."""

    def __init__(self, rgba, depth, render_mode, offset, backgrounds):
        self.rgba, self.depth, self.alphas = rgba, depth, rgba[..., 3:]
        self.has_rgb = "RGB" in render_mode
        # "", "D" or "ED".
        self.kind = render_mode.removeprefix("RGB").removeprefix("+")
        self.offset = offset
        self.backdrop = backgrounds[:, None, None]
        self.least = np.maximum(self.alphas, LEAST_ALPHA)

    def images(self):
        parts = []
        if self.has_rgb:
            own = self.rgba[..., :3] - self.offset * self.alphas
            parts.append(own + self.backdrop * (1 - self.alphas))
        if self.kind:
            parts.append(self.depth / self.least if self.kind == "ED" else self.depth)
        return np.concatenate(parts, axis=-1)

    def backward(self, v_colors, v_alphas):
        """Gradients with respect to `rgba`, `depth` (or None) and the backgrounds."""
        by_rgb = v_colors[..., :3] if self.has_rgb else np.zeros_like(self.rgba[..., :3])
        by_alpha = v_alphas - (by_rgb * (self.backdrop + self.offset)).sum(-1, keepdims=True)
        by_depth = v_colors[..., -1:] if self.kind else None
        if self.kind == "ED":
            by_depth = by_depth / self.least
            by_alpha = by_alpha - np.where(
                self.alphas > LEAST_ALPHA, by_depth * self.depth / self.least, 0
            )
        by_backgrounds = (by_rgb * (1 - self.alphas)).sum(axis=(1, 2))
        return np.concatenate([by_rgb, by_alpha], axis=-1), by_depth, by_backgrounds


def rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane=0.01,
    far_plane=1e10,
    radius_clip=0.0,
    eps2d=0.3,
    sh_degree=None,
    packed=False,
    tile_size=16,
    backgrounds=None,
    render_mode="RGB",
    channel_chunk=32,
    *,
    device=None,
    **others,
):
    """Renders N Gaussians from C cameras, with the arguments and results of gsplat's function of this name.

    `means` (N, 3) in world units; `quats` (N, 4): w, x, y, z of any length above 0; `scales` (N, 3): standard
    deviations in world units, above 0; `opacities` (N,) in [0, 1], of which those nearer than 6e-6 to 0 or 1 count
    as that near; `colors`: RGB of shape (N, 3) or (C, N, 3), or with `sh_degree` (0 to 3) coefficients of
    spherical harmonics, (N, K, 3) or (C, N, K, 3) with K ≥ (sh_degree + 1)²; `viewmats` (C, 4, 4): rigid
    transforms from world to camera coordinates with OpenCV's axes; `Ks` (C, 3, 3) in pixels, without skew.
    `backgrounds` (C, 3). `render_mode`: "RGB", "D" (depth summed with the blending weights), "ED" (its mean), "RGB+D"
    or "RGB+ED". `eps2d` in pixels².

    Returns `(colors, alphas, meta)`: float32 arrays of the shapes (C, height, width, X) and (C, height, width, 1),
    where X is 3, 1 or 4 by the mode, and a dict with `width`, `height`, `n_cameras` and `backward`.
    `meta["backward"](v_colors, v_alphas=None)` takes the gradients of a loss with respect to both and returns, as
    a dict of float32 arrays, those with respect to `means`, `quats`, `scales`, `opacities`, `colors`, `viewmats`
    and, if given, `backgrounds`, in their shapes. That of `viewmats` is exact along rigid motions of the camera, and
    0 along changes that leave no rotation. As in gsplat, gradients do not include the movement of a splat's border,
    where alpha falls below 1/255.

    Not supported: packed results, `radius_clip`, a `far_plane` that culls, other channels than RGB and depth,
    anti-aliasing, cameras other than pinholes, covariances in place of quats and scales, and batches.
    `tile_size` and `channel_chunk` have no effect. `device` is a `splat4d.Device`; default: the best one.

    Raises `ValueError` for wrong shapes, numbers out of range and what is not supported, `splat4d.Error` if the
    device fails."""
    check_options(packed, radius_clip, render_mode, others)
    means = array("means", means, ("N", 3))
    n = len(means)
    if n == 0:
        raise ValueError("means: expected at least one Gaussian")
    quats, scales = array("quats", quats, (n, 4)), array("scales", scales, (n, 3))
    opacities = array("opacities", opacities, (n,)).astype(np.float64)
    viewmats = array("viewmats", viewmats, ("C", 4, 4), np.float64)
    c = len(viewmats)
    cameras = cameras_of(viewmats, array("Ks", Ks, (c, 3, 3), np.float64), width, height)
    if not (scales > 0).all():
        raise ValueError("scales: expected numbers above 0")
    if not ((opacities >= 0) & (opacities <= 1)).all():
        raise ValueError("opacities: expected numbers in [0, 1]")
    if (means @ viewmats[:, 2, :3].T + viewmats[:, 2, 3] >= far_plane).any():
        raise ValueError("far_plane: only a plane behind all Gaussians is supported")
    sh, offset, colors, per_camera = harmonics(colors, sh_degree, n, c)
    has_backgrounds = backgrounds is not None
    backgrounds = array("backgrounds", backgrounds if has_backgrounds else np.zeros((c, 3)), (c, 3))

    opacities = np.clip(opacities, LEAST_OPACITY, 1 - LEAST_OPACITY)
    gaussians = {
        "positions": means,
        "log_scales": np.log(scales),
        "rotations": quats,
        "opacity_logits": np.log(opacities / (1 - opacities)),
    }
    device = device or best_device()

    def trainer(sh):
        scene = Scene(**gaussians, sh=sh)
        scene.set_blending(near=near_plane, dilation=eps2d)
        return Trainer(device, scene, growth=None, sh_degree=scene.sh_degree, sh_interval=0)

    trainers = [trainer(one) for one in sh] if per_camera else [trainer(sh)] * c
    rgba = np.empty((c, height, width, 4), np.float32)
    depth = np.empty((c, height, width, 1), np.float32)
    for i in range(c):
        rendered = trainers[i].forward(cameras[i])
        rgba[i], depth[i, ..., 0] = rendered.rgba, rendered.depth
    pixels = Pixels(rgba, depth, render_mode, offset, backgrounds)
    images, alphas = pixels.images(), pixels.alphas.copy()

    def backward(v_colors, v_alphas=None):
        v_colors = array("v_colors", v_colors, images.shape)
        v_alphas = array("v_alphas", 0 * alphas if v_alphas is None else v_alphas, alphas.shape)
        by_rgba, by_depth, by_backgrounds = pixels.backward(v_colors, v_alphas)
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
        given |= {"colors": colors, "viewmats": viewmats}
        total = {name: np.zeros(value.shape) for name, value in given.items()}
        for i in range(c):
            # A trainer allows a backward pass only right after the forward pass of the same camera.
            trainers[i].forward(cameras[i])
            found = trainers[i].backward(by_rgba[i], None if by_depth is None else by_depth[i, ..., 0])
            total["means"] += found["positions"]
            total["quats"] += found["rotations"]
            total["scales"] += found["log_scales"] / scales
            total["opacities"] += found["opacity_logits"] / (opacities * (1 - opacities))
            by_colors = total["colors"][i] if per_camera else total["colors"]
            if sh_degree is None:
                by_colors += found["sh"][:, 0] / SH_C0
            else:
                by_colors[:, : sh.shape[-2]] += found["sh"]
            total["viewmats"][i] = viewmat_gradient(viewmats[i], found["pose"])
        if has_backgrounds:
            total["backgrounds"] = by_backgrounds
        return {name: value.astype(np.float32) for name, value in total.items()}

    meta = {"width": width, "height": height, "n_cameras": c, "backward": backward}
    return images, alphas, meta
