#!/usr/bin/env python3
"""Writes the models in tests/models that read frames of `splat4d synth --coded`, whose colours say what is true.

    pip install onnx && python3 tools/onnx/coded.py

coded_depth.onnx             depth (z) of one picture, m
coded_flow.onnx              flow from one picture to another, of what moves, too
coded_pointmap_encoder.onnx  a picture as it is
coded_pointmap_decoder.onnx  what two pictures show, in the first's camera, m; also of transposed pictures
coded_mask_encoder.onnx      a picture as it is
coded_mask_decoder.onnx      three masks from prompts: what moves, what does not, nothing

The code is told in src/data/synth/coded.rs.
"""

from functools import cached_property

import numpy as np
from onnx import TensorProto, helper, numpy_helper

import exact

BANDS = 16
NUMBERS, MOVES, INVERSE_DEPTH = 0.2, 0.25, 0.35
LENGTH, FOCAL = 4.0, 4096.0
# Colours of one band differ by what rounding leaves.
ONE_BAND = 1e-4
# Masks are log odds within these.
SURE = 20.0
SIDE = 256


class Graph:
    """Nodes and constants that are being put together."""

    def __init__(self):
        self.nodes, self.constants = [], {}

    def op(self, kind, *inputs, **attributes):
        name = f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, [self.named(one) for one in inputs], [name], **attributes))
        return name

    def named(self, value):
        """The name of a value: a name itself, else a constant of floats."""
        if isinstance(value, str):
            return value
        array = np.asarray(value)
        array = array.astype(np.int64 if array.dtype.kind == "i" else np.float32)
        key = f"c_{array.dtype}_{'x'.join(map(str, array.shape))}_{array.tobytes().hex()}"
        self.constants[key] = array
        return key

    def slice(self, value, axis, first, last):
        return self.op("Slice", value, np.array([first]), np.array([last]), np.array([axis]))

    def shaped(self, value, *shape):
        return self.op("Reshape", value, np.array(shape))

    def where(self, condition, yes, no):
        return self.op("Where", condition, yes, no)

    def sides(self, image):
        """Height and width, as integers without axes."""
        shape = self.op("Shape", image)
        return [self.op("Gather", shape, np.array(axis)) for axis in (2, 3)]

    def save(self, name, inputs, outputs, contract):
        """`inputs` and `outputs` are pairs of a name and a shape; outputs of a value, a name and a shape."""
        for value, to, _ in outputs:
            self.nodes.append(helper.make_node("Identity", [value], [to]))
        tensor = lambda to, shape: helper.make_tensor_value_info(to, TensorProto.FLOAT, shape)
        graph = helper.make_graph(
            self.nodes,
            name,
            [tensor(*one) for one in inputs],
            [tensor(to, shape) for _, to, shape in outputs],
            [numpy_helper.from_array(array, key) for key, array in self.constants.items()],
        )
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
        # Names of constants are long; short ones keep the file small.
        short = {key: f"c{i}" for i, key in enumerate(self.constants)}
        for one in made.graph.initializer:
            one.name = short[one.name]
        for node in made.graph.node:
            node.input[:] = [short.get(one, one) for one in node.input]
        exact.save(made, contract)


class Frame:
    """What a frame's colours say."""

    def __init__(self, graph, image):
        self.graph = g = graph
        red, green, blue = (g.slice(image, 1, c, c + 1) for c in range(3))
        inverse = g.op("Div", g.op("Sub", red, green), INVERSE_DEPTH)
        self.depth = g.op("Div", 1.0, g.op("Max", inverse, 1e-3))
        difference = g.op("Sub", blue, green)
        threshold = 0.5 * (NUMBERS + MOVES)
        # In [0, 1] at a picture's edges between what stands still and what moves.
        self.excess = g.op("Sub", difference, threshold)
        self.moves = g.op("Greater", difference, threshold)
        self.difference = difference
        self.image = image

    @cached_property
    def coded(self):
        """Blue − green without what is added where something moves."""
        return self.graph.op("Sub", self.difference, self.graph.where(self.moves, MOVES, 0.0))

    @cached_property
    def band(self):
        """The number of each pixel's band."""
        return self.graph.op("Floor", self.graph.op("Mul", self.coded, BANDS / NUMBERS))

    @cached_property
    def upright(self):
        """Whether bands change from column to column, and not from row to row as in a transposed picture."""
        g, band = self.graph, self.band

        def change(axis):
            step = g.op("Sub", g.slice(band, axis, 1, 1 << 30), g.slice(band, axis, 0, -1))
            return g.op("ReduceSum", g.op("Abs", step), keepdims=0)

        return g.op("GreaterOrEqual", change(3), change(2))

    @cached_property
    def numbers(self):
        """The numbers of all bands."""
        g = self.graph
        number = self.coded
        pool = {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1]}
        largest = g.op("MaxPool", number, **pool)
        smallest = g.op("Neg", g.op("MaxPool", g.op("Neg", number), **pool))
        inside = g.op("Less", g.op("Sub", largest, smallest), ONE_BAND)
        scaled = g.op("Mul", number, BANDS / NUMBERS)
        band = self.band
        # Around 0, where sums of floats lose least.
        fraction = g.op("Sub", g.op("Sub", scaled, band), 0.5)
        own = g.op("Equal", band, np.arange(BANDS, dtype=np.float32).reshape(1, BANDS, 1, 1))
        taken = g.op("Cast", g.op("And", own, inside), to=TensorProto.FLOAT)
        count = g.op("Max", g.op("ReduceSum", taken, np.array([2, 3])), 1.0)
        sums = g.op("ReduceSum", g.op("Mul", taken, fraction), np.array([2, 3]))
        return g.shaped(g.op("Div", g.op("Div", sums, count), 0.4), BANDS)

    def number(self, first, last):
        return self.graph.slice(self.numbers, 0, first, last)

    def pose(self, first):
        """Rotation and translation, world from camera or from rest."""
        g = self.graph
        q = self.number(first, first + 4)
        q = g.op("Div", q, g.op("Sqrt", g.op("ReduceSum", g.op("Mul", q, q))))
        # Products q_i q_j, of which a rotation's entries are sums.
        products = g.shaped(g.op("Mul", g.shaped(q, 4, 1), g.shaped(q, 1, 4)), 16)
        x, y, z, w = range(4)
        entries = np.zeros((9, 16))
        for row, column, terms in [
            (0, 0, [(-2, y, y), (-2, z, z)]), (0, 1, [(2, x, y), (-2, w, z)]), (0, 2, [(2, x, z), (2, w, y)]),
            (1, 0, [(2, x, y), (2, w, z)]), (1, 1, [(-2, x, x), (-2, z, z)]), (1, 2, [(2, y, z), (-2, w, x)]),
            (2, 0, [(2, x, z), (-2, w, y)]), (2, 1, [(2, y, z), (2, w, x)]), (2, 2, [(-2, x, x), (-2, y, y)]),
        ]:
            for factor, i, j in terms:
                entries[3 * row + column, 4 * i + j] += factor
        rotation = g.op("Add", g.op("MatMul", entries, g.shaped(products, 16, 1)), np.eye(3).reshape(9, 1))
        translation = g.op("Mul", self.number(first + 4, first + 7), LENGTH)
        return g.shaped(rotation, 3, 3), g.shaped(translation, 3, 1)

    def focal(self):
        return self.graph.op("Mul", self.number(7, 8), FOCAL)

    def centred(self):
        """Pixels from the picture's middle, right and down in the camera: of the shape of a channel each."""
        g = self.graph
        along = []
        for side, shape in zip(g.sides(self.image), [(1, 1, -1, 1), (1, 1, 1, -1)]):
            numbers = g.op("Cast", g.op("Range", np.array(0), side, np.array(1)), to=TensorProto.FLOAT)
            middle = g.op("Mul", g.op("Sub", g.op("Cast", side, to=TensorProto.FLOAT), 1.0), 0.5)
            along.append(g.shaped(g.op("Sub", numbers, middle), *shape))
        down, right = along
        flat = g.op("Mul", self.depth, 0.0)
        right, down = g.op("Add", right, flat), g.op("Add", down, flat)
        return g.where(self.upright, right, down), g.where(self.upright, down, right)

    def points(self):
        """What each pixel shows, in the camera: 3 × pixels."""
        g = self.graph
        scale = g.op("Div", self.depth, self.focal())
        right, down = (g.op("Mul", axis, scale) for axis in self.centred())
        return g.shaped(g.op("Concat", right, down, self.depth, axis=1), 3, -1)


def carried(graph, pose, points):
    rotation, translation = pose
    return graph.op("Add", graph.op("MatMul", rotation, points), translation)


def carried_back(graph, pose, points):
    rotation, translation = pose
    return graph.op("MatMul", graph.op("Transpose", rotation, perm=[1, 0]), graph.op("Sub", points, translation))


PICTURE = [1, 3, "height", "width"]
WORLD, REST = 0, 8


def depth():
    g = Graph()
    contract = {"kind": "depth", "version": 1, "input": "image", "output": "depth", "holds": "depth"}
    g.save("coded_depth", [("image", PICTURE)],
           [(Frame(g, "image").depth, "depth", [1, 1, "height", "width"])], contract)


def flow():
    g = Graph()
    here, there = Frame(g, "here"), Frame(g, "there")
    still = carried(g, here.pose(WORLD), here.points())
    moved = carried(g, there.pose(REST), carried_back(g, here.pose(REST), still))
    world = g.where(g.shaped(here.moves, 1, -1), moved, still)
    seen = carried_back(g, there.pose(WORLD), world)
    z = g.op("Max", g.slice(seen, 0, 2, 3), 1e-3)
    pixels = g.op("Mul", g.op("Div", g.slice(seen, 0, 0, 2), z), there.focal())
    own = g.op("Concat", *here.centred(), axis=1)
    ends = g.op("Reshape", pixels, g.op("Shape", own))
    contract = {"kind": "flow", "version": 1, "inputs": ["here", "there"], "output": "flow"}
    g.save("coded_flow", [("here", PICTURE), ("there", PICTURE)],
           [(g.op("Sub", ends, own), "flow", [1, 2, "height", "width"])], contract)


def pointmap():
    g = Graph()
    contract = {"kind": "pointmap_encoder", "version": 1, "input": "image", "output": "tokens",
                "picture": {"multiple": 16, "fit": "crop"}}
    g.save("coded_pointmap_encoder", [("image", PICTURE)], [(g.op("Identity", "image"), "tokens", PICTURE)], contract)

    g = Graph()
    frames = [Frame(g, name) for name in ("tokens_1", "tokens_2")]
    points = [one.points() for one in frames]
    points[1] = carried_back(g, frames[0].pose(WORLD), carried(g, frames[1].pose(WORLD), points[1]))
    outputs = []
    for k, (frame, xyz) in enumerate(zip(frames, points), 1):
        # A transposed picture is what a mirrored camera sees.
        mirrored = g.op("Gather", xyz, np.array([1, 0, 2]), axis=0)
        rows = g.op("Transpose", g.where(frame.upright, xyz, mirrored), perm=[1, 0])
        sides = g.op("Concat", np.array([1]), *(g.shaped(side, 1) for side in g.sides(frame.image)), np.array([3]), axis=0)
        outputs.append((g.op("Reshape", rows, sides), f"points_{k}", [1, "height", "width", 3]))
        sure = g.op("Add", g.op("Mul", g.op("Squeeze", frame.depth, np.array([1])), 0.0), 10.0)
        outputs.append((sure, f"confidence_{k}", [1, "height", "width"]))
    contract = {"kind": "pointmap_decoder", "version": 1, "inputs": ["tokens_1", "tokens_2"],
                "points": ["points_1", "points_2"], "confidence": ["confidence_1", "confidence_2"]}
    g.save("coded_pointmap_decoder", [("tokens_1", PICTURE), ("tokens_2", PICTURE)], outputs, contract)


def mask():
    picture = [1, 3, SIDE, SIDE]
    g = Graph()
    contract = {"kind": "mask_encoder", "version": 1, "input": "image", "outputs": ["features"],
                "picture": {"size": [SIDE, SIDE]}}
    g.save("coded_mask_encoder", [("image", picture)], [(g.op("Identity", "image"), "features", picture)], contract)

    g = Graph()
    frame = Frame(g, "features")
    odds = g.op("Mul", frame.excess, 2 * SURE / MOVES)
    masks = g.op("Concat", odds, g.op("Neg", odds), g.op("Sub", g.op("Mul", odds, 0.0), SURE), axis=1)
    # How many of the points that are on the thing are on what moves.
    places = g.op("Cast", g.op("Floor", g.op("Clip", g.shaped("points", -1, 2), 0.0, SIDE - 1.0)), to=TensorProto.INT64)
    hit = g.op("GatherND", g.shaped(g.op("Cast", frame.moves, to=TensorProto.FLOAT), SIDE, SIDE),
               g.op("Gather", places, np.array([1, 0]), axis=1))
    positive = g.op("Cast", g.op("Equal", g.shaped("labels", -1), 1.0), to=TensorProto.FLOAT)
    count = g.op("Max", g.op("ReduceSum", positive), 1.0)
    share = g.op("Div", g.op("ReduceSum", g.op("Mul", positive, hit)), count)
    scores = g.op("Concat", share, g.op("Sub", 1.0, share), g.op("Mul", share, 0.0), axis=0)
    contract = {"kind": "mask_decoder", "version": 1, "features": ["features"], "points": "points", "labels": "labels",
                "mask_input": "mask_input", "has_mask": "has_mask", "masks": "masks", "scores": "scores"}
    # Inputs that the answer does not depend on have to be read by a node all the same.
    unread = g.op("Mul", g.op("Add", g.op("ReduceMean", "mask_input"), g.op("ReduceMean", "has_mask")), 0.0)
    g.save("coded_mask_decoder",
           [("features", picture), ("points", [1, "prompts", 2]), ("labels", [1, "prompts"]),
            ("mask_input", [1, 1, SIDE, SIDE]), ("has_mask", [1])],
           [(masks, "masks", [1, 3, SIDE, SIDE]), (g.op("Add", g.shaped(scores, 1, 3), g.shaped(unread, 1)), "scores", [1, 3])],
           contract)


if __name__ == "__main__":
    depth()
    flow()
    pointmap()
    mask()
