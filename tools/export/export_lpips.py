#!/usr/bin/env python3
"""LPIPS: how far apart two images look, by the AlexNet, VGG or SqueezeNet variant."""

from pathlib import Path

import torch

import common
from common import Graph, Mistake

# The images are in [-1, 1]; what the backbones were trained with is taken off within the graph.
RULE = {"mean": [0.5] * 3, "deviation": [0.5] * 3}
INPUTS = ["first", "second"]
# Least side for which the backbone's last layer has a value.
LEAST = 64


def run():
    parser = common.arguments(
        __doc__,
        "export_lpips.py --net alex --backbone alexnet-owt-7be5be79.pth --images clip -o lpips_alex.onnx",
        weights="the backbone's, as torchvision has them: alexnet-owt-*.pth, vgg16-*.pth or squeezenet1_1-*.pth",
        flag="--backbone",
        repo="the clone of PerceptualSimilarity [default: the installed package lpips]",
    )
    parser.add_argument("--net", choices=["alex", "vgg", "squeeze"], default="alex",
                        help="the backbone [default: alex]")
    parser.add_argument("--linear", type=Path, metavar="FILE",
                        help="weights of the layers on top [default: version 0.1, which the package has]")
    common.add_sizes(parser, 1)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the file to write")
    given = common.parse(parser)

    if given.repo:
        common.enter(given.repo, "lpips/lpips.py")
    lpips = common.load("lpips")
    # Told to be random, it does not fetch the backbone.
    model = lpips.LPIPS(net=given.net, pretrained=False, pnet_rand=True, verbose=False)
    if given.random_weights:
        common.randomise(model.net, given.seed)
    else:
        backbone(model.net, given.backbone)
    linear = given.linear or Path(lpips.__file__).parent / "weights" / "v0.1" / f"{given.net}.pth"
    # The layers are listed under two names each; the rest was filled above.
    common.fill(model, common.read_checkpoint(linear), linear, ["net.", "lins.", "scaling_layer."])

    sizes = common.whole(given.sizes, 1)
    if min(min(both) for both in sizes) < LEAST:
        raise Mistake(f"--sizes: sides of {LEAST} at least are needed")
    paths = common.files(given.images, len(sizes) + 1)
    samples = [
        (common.label(both), tuple(common.picture(path, both, RULE) for path in paths[i : i + 2]))
        for i, both in enumerate(sizes)
    ]
    with torch.no_grad():
        truth = [common.arrays([model(*inputs)]) for _, inputs in samples]

    contract = {
        "kind": "lpips",
        "version": common.VERSION,
        "inputs": INPUTS,
        "output": "distance",
        "net": given.net,
        "picture": RULE,
    }
    dynamic = {key: {2: "height", 3: "width"} for key in INPUTS}
    graph = Graph(given.output, model, INPUTS, ["distance"], contract, samples, truth, dynamic)
    common.write([graph], given.opset)


def backbone(net, path):
    """Gives the slices of the backbone their weights: a layer keeps the number that it has in torchvision."""
    state = common.read_checkpoint(path, ["state_dict"])
    renamed = {}
    for own in net.state_dict():
        _, layer, kind = own.split(".", 2)
        if (theirs := f"features.{layer}.{kind}") in state:
            renamed[own] = state[theirs]
    common.fill(net, renamed, path)


if __name__ == "__main__":
    common.main(run)
