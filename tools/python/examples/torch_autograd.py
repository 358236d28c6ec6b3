"""The renderer as a `torch.autograd.Function`: PyTorch gets gradients with respect to the arrays of a scene.

    python3 tools/python/examples/torch_autograd.py

PyTorch computes the loss and updates the parameters on the CPU; the engine renders and computes gradients on
its Vulkan device. Needs the packages splat4d and torch.
"""

import numpy as np
import torch

import splat4d

NAMES = ("positions", "log_scales", "rotations", "opacity_logits", "sh")


class Render(torch.autograd.Function):
    """`Render.apply(device, camera, blending, *arrays)` renders Gaussians into an image of shape
    (height, width, 4): premultiplied colour and alpha. `arrays` are the arrays of `splat4d.Scene` in the order
    of NAMES. `blending` is a dict for `Scene.set_blending`.

    The gradients agree with central differences only for a small `alpha_cut`: they do not include the movement
    of a splat's border, where its alpha falls below the cut."""

    @staticmethod
    def forward(ctx, device, camera, blending, *arrays):
        by_name = {name: array.detach().numpy() for name, array in zip(NAMES, arrays)}
        scene = splat4d.Scene(**by_name)
        scene.set_blending(**blending)
        # One trainer per image: a trainer holds the arrays that it was created with.
        ctx.trainer = splat4d.Trainer(
            device, scene, growth=None, sh_degree=scene.sh_degree, sh_interval=0
        )
        ctx.camera, ctx.is_spent = camera, False
        return torch.from_numpy(ctx.trainer.forward(camera).rgba)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_image):
        if ctx.is_spent:
            # A trainer allows one backward pass after each forward pass; a retained graph may need another.
            ctx.trainer.forward(ctx.camera)
        ctx.is_spent = True
        gradients = ctx.trainer.backward(by_image.numpy())
        return None, None, None, *(torch.from_numpy(gradients[name]) for name in NAMES)


def random_gaussians(count, seed):
    random = np.random.default_rng(seed)
    arrays = (
        random.uniform([-1, -0.7, 2.5], [1, 0.7, 4.5], size=(count, 3)),
        np.full((count, 3), -1.8),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.ones(count),
        random.uniform(-1, 1, size=(count, 1, 3)),
    )
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


def main():
    device = splat4d.Device("best")
    camera = splat4d.Camera(128, 96, fx=110.0)
    target = Render.apply(device, camera, {}, *random_gaussians(150, seed=1))
    parameters = [array.requires_grad_() for array in random_gaussians(150, seed=2)]
    optimiser = torch.optim.Adam(parameters, lr=0.02)
    for step in range(100):
        optimiser.zero_grad()
        loss = (Render.apply(device, camera, {}, *parameters) - target).square().mean()
        loss.backward()
        optimiser.step()
        if step % 20 == 0 or step == 99:
            print(f"step {step}: loss {loss.item():.5f}")


if __name__ == "__main__":
    main()
