#!/usr/bin/env python3
"""SEA-RAFT: optical flow from one image to another, and how sure it is."""

import argparse
import json
from pathlib import Path

import torch

import common
from common import Graph, Mistake

# Sides that are multiples of 8 need no padding within the graph.
STRIDE = 8
# Of a configuration, what the network is built by.
NEEDED = ["use_var", "var_min", "var_max", "pretrain", "initial_dim", "block_dims", "radius", "dim", "num_blocks",
          "iters"]
INPUTS = ["first", "second"]
OUTPUTS = ["flow", "confidence"]


class NoPadding:
    """In place of upstream's padding, whose amounts would be those of the traced size."""

    def __init__(self, shape):
        pass

    def pad(self, *pictures):
        return pictures

    def unpad(self, picture):
        return picture


def configuration(path):
    """A configuration of the repository's config folder."""
    try:
        read = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise Mistake(f"--config {path}: {error}") from error
    lacking = [key for key in NEEDED if key not in read]
    if lacking:
        raise Mistake(f"--config {path}: it does not say {', '.join(lacking)}; config/eval holds the right ones")
    return argparse.Namespace(**read)


def estimator(config, half):
    """Flow and confidence by a network, at the images' size or at half of it."""

    def estimate(network, first, second):
        resize = torch.nn.functional.interpolate
        if half:
            first, second = (resize(x, scale_factor=0.5, mode="bilinear") for x in (first, second))
        given = network(first, second, iters=config.iters, test_mode=True)
        flow, info = given["flow"][-1], given["info"][-1]
        # A mixture of two Laplace distributions. The mean of 1 / b over them is 1 where the flow is sure to about
        # a pixel, and near 0 where only the wide one explains it.
        widest = config.var_max if config.use_var else 0
        narrowest = config.var_min if config.use_var else 0
        wide, narrow = info[:, 2:3].clamp(0, widest), info[:, 3:4].clamp(narrowest, 0)
        likely = info[:, :2].softmax(1)
        confidence = (likely * torch.exp(-torch.cat((wide, narrow), dim=1))).sum(1, keepdim=True)
        if half:
            flow, confidence = 2 * resize(flow, scale_factor=2, mode="bilinear"), resize(confidence, scale_factor=2)
        return flow, confidence.clamp(0, 1)

    return estimate


def run():
    parser = common.arguments(
        __doc__,
        "export_sea_raft.py --repo SEA-RAFT --config SEA-RAFT/config/eval/spring-M.json --checkpoint "
        "Tartan-C-T-TSKH-spring540x960-M.pth --images clip -o sea_raft_medium.onnx",
        repo="the clone of SEA-RAFT",
    )
    parser.add_argument("--config", type=Path, metavar="FILE",
                        help="the checkpoint's configuration [default: config/eval/spring-M.json of the clone]")
    parser.add_argument("--iterations", type=int, metavar="N",
                        help="how often the flow is refined [default: as the configuration says]")
    parser.add_argument("--half", action="store_true",
                        help="estimate at half the images' size: for frames of about 1080 rows, as upstream's "
                        "configurations for Spring do with their scale of -1")
    common.add_sizes(parser, STRIDE)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the file to write")
    given = common.parse(parser)

    common.enter(given.repo, "core/raft.py", inside="core")
    config = configuration(given.config or given.repo / "config/eval/spring-M.json")
    if given.iterations is not None:
        if not 1 <= given.iterations <= 32:
            raise Mistake("--iterations: 1 to 32 make sense")
        config.iters = given.iterations
    raft = common.load("raft")
    backbone = raft.ResNetFPN
    # All weights are the checkpoint's: those that upstream begins training with are not fetched.
    with common.replaced((raft, "ResNetFPN", lambda *a, init_weight=False, **k: backbone(*a, init_weight=False, **k))):
        model = raft.RAFT(config).eval()
    if given.random_weights:
        common.randomise(model, given.seed)
    else:
        common.fill(model, common.read_checkpoint(given.checkpoint, ["model", "state_dict"]), given.checkpoint)

    multiple = 2 * STRIDE if given.half else STRIDE
    rule = {"multiple": multiple, "fit": "pad", "white": 255.0}
    sizes = common.whole(given.sizes, multiple)
    for both in sizes:
        # At an eighth of a smaller one the coarsest correlation has a side of one value, and upstream divides by 0.
        if min(both) < 16 * multiple:
            raise Mistake(f"--sizes: {common.label(both)} is too small for the network; sides of {16 * multiple} at "
                          "least are needed")
    paths = common.files(given.images, len(sizes) + 1)
    samples = [
        (common.label(both), tuple(common.picture(path, both, rule) for path in paths[i : i + 2]))
        for i, both in enumerate(sizes)
    ]
    module = common.Wrapped(model, estimator(config, given.half)).eval()
    if given.random_weights:
        common.settle(module, *samples[0][1])
    with torch.no_grad():
        truth = [common.arrays(module(*inputs)) for _, inputs in samples]

    contract = {
        "kind": "flow",
        "version": common.VERSION,
        "inputs": INPUTS,
        "picture": rule,
        "output": "flow",
        "confidence": "confidence",
    }
    dynamic = {key: {2: "height", 3: "width"} for key in INPUTS + OUTPUTS}
    graph = Graph(given.output, module, INPUTS, OUTPUTS, contract, samples, truth, dynamic)
    common.write([graph], given.opset, (raft, "InputPadder", NoPadding))


if __name__ == "__main__":
    common.main(run)
