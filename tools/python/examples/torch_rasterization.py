"""gsplat's `rasterization` on PyTorch tensors: what is written for gsplat runs on a Vulkan device.

    python3 tools/python/examples/torch_rasterization.py

PyTorch computes the loss and updates the parameters on the CPU; the engine renders and computes gradients on
its Vulkan device. Needs the packages splat4d and torch.
"""

import numpy as np
import torch

import splat4d

INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


class Rasterization(torch.autograd.Function):
    """`Rasterization.apply(options, *inputs)` returns colours and alphas. `inputs` are the tensors of INPUTS in
    their order, the last may be None; `options` are the other arguments of `splat4d.rasterization`."""

    @staticmethod
    def forward(ctx, options, *inputs):
        by_name = {
            name: None if tensor is None else tensor.detach().cpu().numpy()
            for name, tensor in zip(INPUTS, inputs)
        }
        colors, alphas, meta = splat4d.rasterization(**by_name, **options)
        ctx.backward_function = meta["backward"]
        ctx.places = [None if tensor is None else (tensor.device, tensor.dtype) for tensor in inputs]
        device = inputs[0].device
        return torch.from_numpy(colors).to(device), torch.from_numpy(alphas).to(device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, v_colors, v_alphas):
        found = ctx.backward_function(v_colors.cpu().numpy(), v_alphas.cpu().numpy())
        gradients = [
            None if place is None or name not in found else torch.from_numpy(found[name]).to(*place)
            for name, place in zip(INPUTS, ctx.places)
        ]
        return None, *gradients


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=None, **options
):
    """gsplat's function, with the arguments that `splat4d.rasterization` supports; tensors in and out. Ks gets no
    gradient."""
    options = {"width": width, "height": height, **options}
    inputs = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    images, alphas = Rasterization.apply(options, *inputs)
    return images, alphas, {"width": width, "height": height, "n_cameras": len(viewmats)}


def random_gaussians(count, seed):
    random = np.random.default_rng(seed)
    arrays = (
        random.uniform([-1, -0.7, 2.5], [1, 0.7, 4.5], size=(count, 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), 0.15),
        np.full(count, 0.7),
        random.uniform(0, 1, size=(count, 3)),
    )
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


def main():
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, 0, 3] = 0.3
    k = torch.tensor([[110.0, 0.0, 64.0], [0.0, 110.0, 48.0], [0.0, 0.0, 1.0]])
    cameras = (viewmats, k.repeat(2, 1, 1), 128, 96)
    target, _, _ = rasterization(*random_gaussians(150, seed=1), *cameras)
    means, quats, scales, opacities, colors = random_gaussians(150, seed=2)
    # Scales and opacities are trained as logarithms and logits, which keeps them in range.
    parameters = [means, quats, scales.log(), opacities.logit(), colors]
    parameters = [parameter.requires_grad_() for parameter in parameters]
    optimiser = torch.optim.Adam(parameters, lr=0.02)
    for step in range(100):
        optimiser.zero_grad()
        means, quats, log_scales, logits, colors = parameters
        images, _, _ = rasterization(
            means, quats, log_scales.exp(), logits.sigmoid(), colors, *cameras
        )
        loss = (images - target).square().mean()
        loss.backward()
        optimiser.step()
        if step % 20 == 0 or step == 99:
            print(f"step {step}: loss {loss.item():.5f}")


if __name__ == "__main__":
    main()
