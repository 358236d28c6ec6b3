"""PyTorch's gradcheck of the example's renderer: every derivative of every channel of every pixel, against central
differences. The engine computes in f32, which the step and the tolerances follow."""

import sys
from pathlib import Path

import torch

import splat4d

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from torch_autograd import Render, random_gaussians  # noqa: E402

device = splat4d.Device("software")
camera = splat4d.Camera(9, 7, fx=8.0)
# With the usual cut, the border of a splat jumps, and differences differ from the gradient.
blending = {"alpha_cut": 1e-6}
arrays = [array.double().requires_grad_() for array in random_gaussians(3, seed=4)]
assert torch.autograd.gradcheck(
    lambda *arrays: Render.apply(device, camera, blending, *arrays),
    arrays, eps=5e-3, atol=2e-3, rtol=1e-2,
)
print("gradcheck passed")
