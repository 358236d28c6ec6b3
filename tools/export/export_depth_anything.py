#!/usr/bin/env python3
"""Depth Anything V2: relative inverse depth of one image, or metric depth with the metric checkpoints."""

from pathlib import Path

import torch

import common
from common import Graph, Mistake

# Of the repository's run.py. The giant one is above the 2 GiB that a single ONNX file can hold.
VARIANTS = {
    "vits": {"features": 64, "out_channels": [48, 96, 192, 384]},
    "vitb": {"features": 128, "out_channels": [96, 192, 384, 768]},
    "vitl": {"features": 256, "out_channels": [256, 512, 1024, 1024]},
}
PATCH = 14
RULE = {"multiple": PATCH, "shorter": 518, **common.IMAGENET}


def cubic(x):
    """The kernel of PyTorch's bicubic interpolation, a = −0.75."""
    a, x = -0.75, x.abs()
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return torch.where(x <= 1, near, torch.where(x < 2, far, torch.zeros_like(x)))


def resampling(places, scale, size):
    """The matrix that interpolates a row of `size` values, repeated beyond its ends, at as many places."""
    at = (torch.arange(places, dtype=torch.float32) + 0.5) / scale - 0.5
    # The kernel reaches over the ends by two values.
    positions = torch.arange(-3, size + 3, dtype=torch.float32)
    weights = cubic(at[:, None] - positions[None, :])
    # What is beyond an end counts for the value there.
    ends = torch.zeros(len(positions), size)
    ends[torch.arange(len(positions)), positions.long().clamp(0, size - 1)] = 1
    return weights @ ends


def position_embedding(self, x, width, height):
    """The embedding of positions at the image's size, by products of matrices that are made within the graph.

    Upstream's interpolation takes its factor as a number of Python, so that its graph is right for one size only.
    What upstream calls width is the first of the two axes.
    """
    known = self.patch_embed.patches_resolution[0]
    rows, columns = width // PATCH, height // PATCH
    sides = [torch.as_tensor(side, dtype=torch.float32) for side in (rows, columns)]
    # At the size of training it is not interpolated.
    same = (sides[0] == known) & (sides[1] == known)
    scales = [torch.where(same, 1.0, (side + self.interpolate_offset) / known) for side in sides]
    down, right = (resampling(n, scale, known) for n, scale in zip((rows, columns), scales))
    channels = self.pos_embed[0, 1:].reshape(known, known, -1).permute(2, 0, 1)
    grid = down @ channels @ right.T
    return torch.cat((self.pos_embed[:, :1], grid.flatten(1).T[None]), dim=1)


def run():
    parser = common.arguments(
        __doc__,
        "export_depth_anything.py --repo Depth-Anything-V2 --checkpoint depth_anything_v2_vits.pth --images clip "
        "-o depth_anything_v2_small.onnx",
        repo="the clone of Depth-Anything-V2",
    )
    parser.add_argument("--variant", choices=VARIANTS, default="vits", help="the encoder [default: vits]")
    parser.add_argument("--metric", type=float, metavar="FARTHEST",
                        help="the checkpoint is one for metric depth up to so many metres (20 indoors, 80 outdoors)")
    common.add_shorter(parser, RULE["shorter"])
    common.add_sizes(parser, PATCH)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the file to write")
    given = common.parse(parser)
    if given.metric is not None and not given.metric > 0:
        raise Mistake("--metric: a distance above 0 is needed")

    inside = "metric_depth" if given.metric else "."
    common.enter(given.repo, f"{inside}/depth_anything_v2/dpt.py", inside=inside)
    dpt = common.load("depth_anything_v2.dpt")
    for layers in ["attention", "block"]:
        # Its kernels run on CUDA only; the plain attention computes the same.
        common.load(f"depth_anything_v2.dinov2_layers.{layers}").XFORMERS_AVAILABLE = False

    more = {"max_depth": given.metric} if given.metric else {}
    model = dpt.DepthAnythingV2(encoder=given.variant, **VARIANTS[given.variant], **more).eval()
    if given.random_weights:
        common.randomise(model, given.seed)
        # Else the last rectifier may leave nothing.
        torch.nn.init.constant_(model.depth_head.scratch.output_conv2[2].bias, 1.0)
    else:
        common.fill(model, common.read_checkpoint(given.checkpoint), given.checkpoint)

    sizes = common.whole(given.sizes, PATCH)
    paths = common.files(given.images, len(sizes))
    samples = [(common.label(both), (common.picture(path, both, RULE),)) for path, both in zip(paths, sizes)]
    with torch.no_grad():
        truth = [common.arrays([model(*inputs)]) for _, inputs in samples]

    contract = {
        "kind": "depth",
        "version": common.VERSION,
        "input": "image",
        "picture": {**RULE, "shorter": given.shorter},
        "output": "depth",
        "holds": "depth" if given.metric else "shifted_inverse",
    }
    dynamic = {key: {axis: "height", axis + 1: "width"} for key, axis in [("image", 2), ("depth", 1)]}
    graph = Graph(given.output, model, ["image"], ["depth"], contract, samples, truth, dynamic)
    common.write(
        [graph],
        given.opset,
        (type(model.pretrained), "interpolate_pos_encoding", position_embedding),
        # The head makes Python numbers of sizes; so they stay part of the graph.
        (dpt, "int", lambda side: side),
    )


if __name__ == "__main__":
    common.main(run)
