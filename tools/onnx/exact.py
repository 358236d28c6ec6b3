#!/usr/bin/env python3
"""Writes the small models in tests/models, whose answers are exact: what they say is in the colours.

    pip install onnx && python3 tools/onnx/exact.py

depth.onnx   1 / z = 0.5 + 2 red, of one picture; its contract is in its metadata
bare.onnx    the same without a contract
flow.onnx    (u, v) = 8 (red, green of the second picture − those of the first); confidence: blue of the first
lpips.onnx   the mean squared difference of two pictures with values from −1 to 1
mask_encoder.onnx        features: the picture; without a contract, as all for masks
mask_decoder.onnx        masks 20 (red − 0.5), its negative, and −3 + the mask to begin with, if there is one; scores
                         Σ label · x, Σ label · y, and whether there is a mask to begin with
mask_decoder_small.onnx  of 8 × 16: 20 (mean red − 0.5) + the mask to begin with; the same scores; for what is wrong
                         `first`, a single mask, and `coarse`, a mask of one pixel
features.onnx  keypoints: red; descriptors: the mean colour of cells of 4 × 4 pixels; reliability: their mean blue
pointmap_encoder.onnx  that of a pointmap network without a contract: the picture itself
pointmap_decoder.onnx  its decoder: the first picture's points (red, green, 1 + blue), confidence 1 + red; the
             second one's are of the sum of both colours, confidence 1 + blue
pointmap_uneven.onnx   the same with every other column of points left out
"""

import json
from pathlib import Path

import onnx
from onnx import TensorProto, helper

FOLDER = Path(__file__).parents[2] / "tests" / "models"


def model(name, nodes, inputs, outputs, constants, contract, sides=("height", "width")):
    """A model of the oldest versions that the runtime's oldest supported release reads. An input by name is a picture,
    others have their shape; an output with a number has so many channels of these sides, others have their shape."""
    picture = [1, 3, "height", "width"]
    inputs = [one if isinstance(one, tuple) else (one, picture) for one in inputs]
    outputs = [(o, [1, shape, *sides] if isinstance(shape, int) else shape) for o, shape in outputs]
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info(i, TensorProto.FLOAT, shape) for i, shape in inputs],
        [helper.make_tensor_value_info(o, TensorProto.FLOAT, shape) for o, shape in outputs],
        [
            helper.make_tensor(key, TensorProto.INT64 if isinstance(values[0], int) else TensorProto.FLOAT,
                               [len(values)] if isinstance(values[0], int) else [], values)
            for key, values in constants.items()
        ],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), contract)


def channels(source, first, last):
    """A node that takes channels of a picture, and its constants."""
    name = f"{source}_{first}_{last}"
    node = helper.make_node("Slice", [source, f"{name}_first", f"{name}_last", "axis"], [name])
    return name, node, {f"{name}_first": [first], f"{name}_last": [last]}


def depth(name, contract):
    red, take, constants = channels("image", 0, 1)
    nodes = [
        take,
        helper.make_node("Mul", [red, "two"], ["scaled"]),
        helper.make_node("Add", ["scaled", "half"], ["inverse"]),
    ]
    constants |= {"axis": [1], "two": [2.0], "half": [0.5]}
    model(name, nodes, ["image"], [("inverse", 1)], constants, contract)


def flow():
    nodes, constants, taken = [], {"axis": [1], "eight": [8.0]}, {}
    for source, first, last in [("here", 0, 2), ("there", 0, 2), ("here", 2, 3)]:
        taken[source, first], node, more = channels(source, first, last)
        nodes.append(node)
        constants |= more
    nodes += [
        helper.make_node("Sub", [taken["there", 0], taken["here", 0]], ["change"]),
        helper.make_node("Mul", ["change", "eight"], ["flow"]),
        helper.make_node("Identity", [taken["here", 2]], ["confidence"]),
    ]
    contract = {
        "kind": "flow",
        "version": 1,
        "inputs": ["here", "there"],
        "output": "flow",
        "confidence": "confidence",
        "picture": {"multiple": 8, "fit": "pad"},
    }
    model("flow", nodes, ["here", "there"], [("flow", 2), ("confidence", 1)], constants, contract)


def lpips():
    nodes = [
        helper.make_node("Sub", ["first", "second"], ["change"]),
        helper.make_node("Mul", ["change", "change"], ["squared"]),
        helper.make_node("ReduceMean", ["squared"], ["distance"], axes=[1, 2, 3]),
    ]
    contract = {
        "kind": "lpips",
        "version": 1,
        "inputs": ["first", "second"],
        "output": "distance",
        "net": "squared difference",
        "picture": {"mean": [0.5] * 3, "deviation": [0.5] * 3},
    }
    model("lpips", nodes, ["first", "second"], [("distance", 1)], {}, contract, sides=(1, 1))


def mask_encoder():
    nodes = [helper.make_node("Identity", ["image"], ["features"])]
    model("mask_encoder", nodes, ["image"], [("features", 3)], {}, None)


def mask_prompts(rows, columns):
    """The inputs of a decoder of masks with these sides, and what its scores are made by."""
    inputs = [
        "features",
        ("points", [1, "prompts", 2]),
        ("labels", [1, "prompts"]),
        ("mask_input", [1, 1, rows, columns]),
        ("has_mask", [1]),
    ]
    nodes = [
        helper.make_node("Unsqueeze", ["labels", "last"], ["label"]),
        helper.make_node("Mul", ["points", "label"], ["counted"]),
        helper.make_node("ReduceSum", ["counted", "axis"], ["sums"], keepdims=0),
        helper.make_node("Unsqueeze", ["has_mask", "axis"], ["begun"]),
        helper.make_node("Concat", ["sums", "begun"], ["scores"], axis=1),
        helper.make_node("Mul", ["mask_input", "has_mask"], ["before"]),
    ]
    return inputs, nodes, {"axis": [1], "last": [2], "half": [0.5], "twenty": [20.0], "three": [3.0]}


def mask_decoder():
    inputs, nodes, constants = mask_prompts("height", "width")
    red, take, more = channels("features", 0, 1)
    nodes += [
        take,
        helper.make_node("Sub", [red, "half"], ["beyond"]),
        helper.make_node("Mul", ["beyond", "twenty"], ["odds"]),
        helper.make_node("Neg", ["odds"], ["against"]),
        helper.make_node("Sub", ["before", "three"], ["level"]),
        helper.make_node("Concat", ["odds", "against", "level"], ["masks"], axis=1),
    ]
    outputs = [("masks", 3), ("scores", [1, 3])]
    model("mask_decoder", nodes, inputs, outputs, constants | more, None)


def mask_decoder_small():
    inputs, nodes, constants = mask_prompts(8, 16)
    red, take, more = channels("features", 0, 1)
    nodes += [
        take,
        helper.make_node("Sub", [red, "half"], ["beyond"]),
        helper.make_node("Mul", ["beyond", "twenty"], ["odds"]),
        helper.make_node("ReduceMean", ["odds"], ["coarse"], axes=[2, 3]),
        helper.make_node("Add", ["coarse", "before"], ["first"]),
        helper.make_node("Neg", ["first"], ["against"]),
        helper.make_node("Sub", ["before", "three"], ["level"]),
        helper.make_node("Concat", ["first", "against", "level"], ["masks"], axis=1),
    ]
    outputs = [("masks", 3), ("first", 1), ("coarse", [1, 1, 1, 1]), ("scores", [1, 3])]
    model("mask_decoder_small", nodes, inputs, outputs, constants | more, None, sides=(8, 16))


def features():
    red, take, constants = channels("image", 0, 1)
    blue, take_blue, more = channels("descriptors", 2, 3)
    nodes = [
        take,
        helper.make_node("Identity", [red], ["keypoints"]),
        helper.make_node("AveragePool", ["image"], ["descriptors"], kernel_shape=[4, 4], strides=[4, 4]),
        take_blue,
        helper.make_node("Identity", [blue], ["reliability"]),
    ]
    contract = {
        "kind": "features",
        "version": 1,
        "input": "image",
        "descriptors": "descriptors",
        "keypoints": "keypoints",
        "reliability": "reliability",
        "picture": {"multiple": 4, "fit": "pad"},
    }
    cells = ["rows", "columns"]
    outputs = [("keypoints", 1), ("descriptors", [1, 3, *cells]), ("reliability", [1, 1, *cells])]
    model("features", nodes, ["image"], outputs, constants | more | {"axis": [1]}, contract)


def save(made, contract):
    made.producer_name = "splat4d"
    if contract:
        helper.set_model_props(made, {"splat4d": json.dumps(contract, sort_keys=True)})
    onnx.checker.check_model(made, full_check=True)
    onnx.save(made, FOLDER / f"{made.graph.name}.onnx")


def pointmap_encoder():
    picture = [1, 3, "height", "width"]
    graph = helper.make_graph(
        [helper.make_node("Identity", ["image"], ["tokens"])],
        "pointmap_encoder",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, picture)],
        [helper.make_tensor_value_info("tokens", TensorProto.FLOAT, picture)],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), None)


def pointmap_decoder(name, step):
    nodes = [helper.make_node("Add", ["first", "second"], ["sum"])]
    sources = [("first", "first", 0), ("sum", "second", 2)]
    for k, (points, confidence, channel) in enumerate(sources):
        nodes += [
            helper.make_node("Slice", [points, "none", "all", "columns", step], [f"cut{k}"]),
            helper.make_node("Transpose", [f"cut{k}"], [f"last{k}"], perm=[0, 2, 3, 1]),
            helper.make_node("Add", [f"last{k}", "ahead"], [f"points{k}"]),
            helper.make_node("Slice", [confidence, f"c{channel}", f"c{channel + 1}", "channels"], [f"one{k}"]),
            helper.make_node("Squeeze", [f"one{k}", "channels"], [f"plane{k}"]),
            helper.make_node("Add", [f"plane{k}", "unit"], [f"confidence{k}"]),
        ]
    whole = {"none": [0], "all": [1 << 30], "columns": [3], "channels": [1], step: [int(step[-1])]}
    whole |= {f"c{c}": [c] for c in range(4)}
    constants = [helper.make_tensor(key, TensorProto.INT64, [1], value) for key, value in whole.items()]
    constants.append(helper.make_tensor("ahead", TensorProto.FLOAT, [3], [0.0, 0.0, 1.0]))
    constants.append(helper.make_tensor("unit", TensorProto.FLOAT, [], [1.0]))
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        name,
        [value(i, TensorProto.FLOAT, [1, 3, "height", "width"]) for i in ("first", "second")],
        [value(f"points{k}", TensorProto.FLOAT, [1, "rows", "columns", 3]) for k in range(2)]
        + [value(f"confidence{k}", TensorProto.FLOAT, [1, "height", "width"]) for k in range(2)],
        constants,
    )
    contract = {
        "kind": "pointmap_decoder",
        "version": 1,
        "inputs": ["first", "second"],
        "points": ["points0", "points1"],
        "confidence": ["confidence0", "confidence1"],
    }
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), contract)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    depth("depth", {
        "kind": "depth",
        "version": 1,
        "input": "image",
        "output": "inverse",
        "holds": "shifted_inverse",
        "picture": {"multiple": 14, "fit": "pad"},
    })
    depth("bare", None)
    flow()
    lpips()
    mask_encoder()
    mask_decoder()
    mask_decoder_small()
    features()
    pointmap_encoder()
    pointmap_decoder("pointmap_decoder", "by1")
    pointmap_decoder("pointmap_uneven", "by2")
