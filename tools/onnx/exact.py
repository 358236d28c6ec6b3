#!/usr/bin/env python3
"""Writes the small models in tests/models, whose answers are exact: what they say is in the colours.

    pip install onnx && python3 tools/onnx/exact.py

depth.onnx   1 / z = 0.5 + 2 red, of one picture; its contract is in its metadata
bare.onnx    the same without a contract
flow.onnx    (u, v) = 8 (red, green of the second picture − those of the first); confidence: blue of the first
lpips.onnx   the mean squared difference of two pictures with values from −1 to 1
"""

import json
from pathlib import Path

import onnx
from onnx import TensorProto, helper

FOLDER = Path(__file__).parents[2] / "tests" / "models"


def model(name, nodes, inputs, outputs, constants, contract, sides=("height", "width")):
    """A model of the oldest versions that the runtime's oldest supported release reads; outputs have these sides."""
    picture = [1, 3, "height", "width"]
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info(i, TensorProto.FLOAT, picture) for i in inputs],
        [
            helper.make_tensor_value_info(o, TensorProto.FLOAT, [1, channels, *sides])
            for o, channels in outputs
        ],
        [
            helper.make_tensor(key, TensorProto.INT64 if isinstance(values[0], int) else TensorProto.FLOAT,
                               [len(values)] if isinstance(values[0], int) else [], values)
            for key, values in constants.items()
        ],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    made.producer_name = "splat4d"
    if contract:
        helper.set_model_props(made, {"splat4d": json.dumps(contract, sort_keys=True)})
    onnx.checker.check_model(made, full_check=True)
    onnx.save(made, FOLDER / f"{name}.onnx")


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
