"""What the exporters share: the command line, loading of weights, images, the export itself and its proof.

An exporter describes each file as a `Graph`. `write` exports all of them to files beside the final ones, runs each
through the ONNX Runtime and compares with what the upstream code computes, before anything was replaced in it.
Only when all agree do they get their names.
"""

import argparse
import contextlib
import importlib
import json
import os
import sys
import types
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from PIL import Image

# How far an output may be from PyTorch's: the largest |ONNX Runtime − PyTorch|, relative to the largest
# |PyTorch − its mean|. The mean is taken off so that an output far from 0 that hardly varies proves nothing by that;
# for outputs of a few numbers it stays.
LIMIT = 1e-3
FEW = 16
METADATA_KEY = "splat4d"
VERSION = 1
IMAGENET = {"mean": [0.485, 0.456, 0.406], "deviation": [0.229, 0.224, 0.225]}


class Mistake(Exception):
    """Something that the user can mend; its text says how."""


class Disagreement(Exception):
    """The exported graph computes something else than the network."""


@dataclass
class Graph:
    """A file to write."""

    path: Path
    # Takes the tensors of a sample, gives a tuple of tensors.
    module: torch.nn.Module
    inputs: list
    outputs: list
    contract: dict
    # Pairs of a label and the inputs.
    samples: list
    # For each sample what upstream's own code gives, as a tuple of arrays.
    truth: list
    # Names of axes that may have any size, by name of the tensor: {"image": {2: "height", 3: "width"}}.
    dynamic: dict = field(default_factory=dict)


# The command line


def arguments(description, example, repo, weights="the checkpoint", flag="--checkpoint"):
    """A parser with what all exporters take. An exporter adds its own options and calls `parse`."""
    parser = argparse.ArgumentParser(
        description=description,
        epilog=f"Example:\n  {example}\n\nExit code: 0 written, 1 it would compute something else than PyTorch, "
        "2 something given is wrong.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--repo", type=Path, metavar="DIR", help=repo)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(flag, type=Path, metavar="FILE", help=weights)
    source.add_argument("--random-weights", action="store_true",
                        help="random weights of the real architecture, for tests")
    parser.add_argument("--seed", type=int, default=0, help="of random weights [default: 0]")
    parser.add_argument("--images", type=Path, metavar="DIR", required=True,
                        help="images on which ONNX Runtime and PyTorch are compared; at least two, for networks "
                        "of pairs in the order of a video")
    parser.add_argument("--opset", type=int, choices=range(16, 21), default=17,
                        help="the ONNX operator set, 16 to 20 [default: 17]", metavar="N")
    return parser


def parse(parser):
    """What the user gave."""
    given = parser.parse_args()
    # Some networks draw constants when they are made.
    torch.manual_seed(given.seed)
    return given


def size(text):
    """Reads WIDTHxHEIGHT."""
    try:
        width, height = (int(side) for side in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"`{text}` is no size such as 512x288") from None
    if not (16 <= min(width, height) and max(width, height) <= 8192):
        raise argparse.ArgumentTypeError(f"`{text}`: sides from 16 to 8192 make sense")
    return width, height


def shorter_side(text):
    """Reads the shorter side of an image."""
    try:
        pixels = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"`{text}` is no number of pixels") from None
    if not 0 <= pixels <= 8192:
        raise argparse.ArgumentTypeError("0 to 8192 make sense")
    return pixels


def add_shorter(parser, default):
    """The option for the size at which a network for images of any size is run."""
    parser.add_argument("--shorter", type=shorter_side, default=default, metavar="PIXELS",
                        help="the shorter side at which splat4d is to run it; 0: the frame's own "
                        f"[default: {default}]")


def add_sizes(parser, multiple):
    """The option for the sizes at which a network for images of any size is compared."""
    parser.add_argument("--sizes", type=size, nargs="+", default=[(512, 288), (384, 256)], metavar="WxH",
                        help="sizes at which it is compared, at least two, taken to the nearest multiples of "
                        f"{multiple} [default: 512x288 384x256]")


def whole(sizes, multiple):
    """Sizes of which both sides are multiples of a number."""
    near = [tuple(max(1, round(side / multiple)) * multiple for side in both) for both in sizes]
    if len(set(near)) < 2:
        raise Mistake(f"--sizes: at least two are needed that differ as multiples of {multiple}")
    return near


def main(run):
    """Runs an exporter and gives its exit code."""
    warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    warnings.filterwarnings("ignore", category=UserWarning)
    try:
        run()
    except Mistake as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        sys.exit(2)
    except Disagreement as disagreement:
        print(f"error: {disagreement}", file=sys.stderr)
        sys.exit(1)


# The user's clone


def folder(repo):
    """That a clone is given and there."""
    if repo is None:
        raise Mistake("--repo DIR is needed: a clone of the network's repository")
    if not repo.is_dir():
        raise Mistake(f"--repo {repo}: there is no such folder")


def enter(repo, *needed, inside="."):
    """Makes a clone's modules importable; `needed` are files that tell it from any other folder."""
    folder(repo)
    for file in needed:
        if not (repo / file).is_file():
            raise Mistake(f"--repo {repo}: it has no {file}; a clone of the network's repository is needed")
    sys.path.insert(0, str((repo / inside).resolve()))


def load(name):
    """Imports a module of the clone."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Mistake(f"the network's code does not load: {error}; tools/export/requirements.txt lists what it "
                      "needs") from error


def placeholder(name, *attributes):
    """Stands in for a module that the clone imports and the network does not compute with."""
    module = types.ModuleType(name)
    for attribute in attributes:
        setattr(module, attribute, None)
    sys.modules[name] = module


@contextlib.contextmanager
def replaced(*replacements):
    """Replaces attributes, given as (object, name, value), while the block runs."""
    missing = object()
    # Of what the object itself holds: a class's attribute or a module's built-in is not taken for its own.
    before = [(target, name, vars(target).get(name, missing)) for target, name, _ in replacements]
    for target, name, value in replacements:
        setattr(target, name, value)
    try:
        yield
    finally:
        for target, name, value in before:
            if value is missing:
                delattr(target, name)
            else:
                setattr(target, name, value)


# Weights


def read_checkpoint(path, inner=()):
    """The tensors of a checkpoint by name; `inner` are keys under which they may lie."""
    if not path.is_file():
        raise Mistake(f"{path}: there is no such file")
    try:
        # Checkpoints of training runs often hold their options too.
        with torch.serialization.safe_globals([argparse.Namespace]):
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise Mistake(f"{path} is no checkpoint of PyTorch, or it holds more than weights and options") from error
    for key in inner:
        if isinstance(state, dict) and isinstance(state.get(key), dict):
            state = state[key]
            break
    if not isinstance(state, dict):
        raise Mistake(f"{path} holds no weights by name")
    # Left by training on several devices.
    state = {name.removeprefix("module."): value for name, value in state.items() if torch.is_tensor(value)}
    if not state:
        raise Mistake(f"{path} holds no weights by name")
    return state


def fill(module, state, path, unneeded=()):
    """Gives a network its weights; names that begin with one of `unneeded` may lack or be left over."""
    own = module.state_dict()

    def told(names):
        names = sorted(name for name in names if not name.startswith(tuple(unneeded)))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return names and ", ".join(names[:3]) + more

    wrong = []
    if lacking := told(set(own) - set(state) - {name for name in own if name.endswith("num_batches_tracked")}):
        wrong.append(f"it lacks {lacking}")
    if foreign := told(set(state) - set(own)):
        wrong.append(f"the network has no {foreign}")
    both = set(own) & set(state)
    if shapes := told(name for name in both if own[name].shape != state[name].shape):
        wrong.append(f"the shapes differ of {shapes}")
    if wrong:
        raise Mistake(f"{path} does not fit the network: {'; '.join(wrong)}. Does the variant fit the checkpoint?")
    module.load_state_dict({name: state[name] for name in both}, strict=False)


def randomise(module, seed):
    """Random weights, drawn about those that the network begins with.

    What begins as zero, one or tiny is moved, so that no branch is left out of the comparison: biases, scales
    of layers, the statistics of normalisations.
    """
    draw = torch.Generator().manual_seed(seed)

    def noise(value):
        return torch.randn(value.shape, generator=draw, dtype=value.dtype)

    with torch.no_grad():
        for value in module.parameters():
            if value.numel() == 0 or not value.is_floating_point():
                continue
            if value.numel() == 1 or float(value.std()) < 1e-4:
                value += 0.05 * noise(value)
            else:
                value.copy_(float(value.std()) * noise(value) + float(value.mean()))
        for name, value in module.named_buffers():
            if name.endswith("running_mean"):
                value += 0.1 * noise(value)
            elif name.endswith("running_var"):
                value *= torch.exp(0.1 * noise(value))


def settle(module, *inputs):
    """Sets the statistics of a random network's normalisations by what they meet.

    Else values grow from layer to layer, and so does their rounding, until nothing can be compared.
    """
    layers = [layer for layer in module.modules() if isinstance(layer, torch.nn.BatchNorm2d)]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.train()
        layer.momentum = 1.0
    with torch.no_grad():
        module(*inputs)
    for layer, momentum in zip(layers, momenta):
        layer.eval()
        layer.momentum = momentum


# Images


def files(images, count):
    """The first images of a folder, by name."""
    if not images.is_dir():
        raise Mistake(f"--images {images}: there is no such folder")
    kinds = {".png", ".jpg", ".jpeg", ".webp", ".bmp"}
    found = sorted(path for path in images.iterdir() if path.suffix.lower() in kinds)
    if len(found) < count:
        raise Mistake(f"--images {images}: {count} images are needed, it has {len(found)}")
    return found[:count]


def picture(path, both, rule):
    """An image as splat4d makes it by a contract's rule, at a given width and height: 1 × 3 × height × width."""
    try:
        with Image.open(path) as opened:
            image = opened.convert("RGB").resize(both, Image.Resampling.BICUBIC)
    except OSError as error:
        raise Mistake(f"{path} is no image: {error}") from error
    pixels = np.asarray(image, np.float32) / 255 * rule.get("white", 1.0)
    pixels = (pixels - np.float32(rule.get("mean", [0] * 3))) / np.float32(rule.get("deviation", [1] * 3))
    return torch.from_numpy(pixels.transpose(2, 0, 1)[None].astype(np.float32))


def label(both):
    """A size as it is written."""
    return "{}x{}".format(*both)


# The export


def arrays(tensors):
    """A network's outputs as arrays, copied: later runs may reuse their memory."""
    return tuple(np.array(tensor.detach().numpy(), copy=True) for tensor in tensors)


def compare(graph, file):
    """Runs a file on each sample; prints and judges how far it is from the truth."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    worst = 0.0
    for (label, inputs), truth in zip(graph.samples, graph.truth, strict=True):
        feed = {key: value.numpy() for key, value in zip(graph.inputs, inputs, strict=True)}
        given = session.run(graph.outputs, feed)
        for output, ours, theirs in zip(graph.outputs, given, truth, strict=True):
            what = f"{graph.path.name} at {label}, {output}"
            if ours.shape != theirs.shape:
                raise Disagreement(f"{what}: ONNX Runtime gives {ours.shape}, PyTorch {theirs.shape}")
            theirs = theirs.astype(np.float64)
            largest = np.abs(theirs).max()
            spread = largest if theirs.size <= FEW else np.abs(theirs - theirs.mean()).max()
            if not np.isfinite(theirs).all() or spread == 0:
                raise Disagreement(f"{what}: PyTorch's output does not vary or is not finite, and proves nothing")
            off = np.abs(ours - theirs).max()
            error = float(off / spread)
            print(f"{what}: {'x'.join(map(str, theirs.shape))}, largest |value| {largest:.4g}, largest difference "
                  f"relative to it {off / largest:.1e}, to the spread {error:.1e}", flush=True)
            # A NaN is no agreement either.
            worst = max(worst, error) if error == error else float("inf")
    if not worst <= LIMIT:
        raise Disagreement(f"{graph.path.name} is {worst:.2e} from PyTorch, allowed is {LIMIT:.0e}; nothing written")


def describe(file, graph):
    """Writes the contract into a file's metadata, and the outputs' shapes as far as they are known."""
    model = onnx.load(file)
    model.producer_name = "splat4d tools/export"
    # Names of modules and code lines, which the exporter leaves behind, would name folders of this machine.
    model.doc_string = ""
    for node in model.graph.node:
        node.doc_string = ""
    # Tracing leaves names for axes that have one size only.
    for output, truth in zip(model.graph.output, graph.truth[0], strict=True):
        free = graph.dynamic.get(output.name, {})
        for axis, (dimension, side) in enumerate(zip(output.type.tensor_type.shape.dim, truth.shape, strict=True)):
            if axis in free:
                dimension.dim_param = free[axis]
            else:
                dimension.dim_value = side
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(graph.contract, sort_keys=True)})
    onnx.save(model, file)
    onnx.checker.check_model(str(file))


def write(graphs, opset, *replacements):
    """Exports, compares and names the files. `replacements` are for `replaced`, while the graphs are traced."""
    parts = []
    try:
        for graph in graphs:
            if not graph.path.parent.is_dir():
                raise Mistake(f"{graph.path.parent}: there is no such folder")
            part = graph.path.parent / f".{graph.path.name}.part"
            parts.append(part)
            with torch.no_grad(), replaced(*replacements):
                torch.onnx.export(
                    graph.module.eval(),
                    graph.samples[0][1],
                    str(part),
                    input_names=graph.inputs,
                    output_names=graph.outputs,
                    dynamic_axes=graph.dynamic or None,
                    opset_version=opset,
                    do_constant_folding=True,
                    # The graph is traced: sizes that the network computes with stay part of it.
                    dynamo=False,
                )
            describe(part, graph)
            compare(graph, part)
        for graph, part in zip(graphs, parts, strict=True):
            os.replace(part, graph.path)
            print(f"wrote {graph.path}, {graph.path.stat().st_size / 2**20:.1f} MiB")
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


class Wrapped(torch.nn.Module):
    """A function of tensors as a module; the network that it calls is part of it."""

    def __init__(self, network, function):
        super().__init__()
        self.network = network
        self.function = function

    def forward(self, *inputs):
        return self.function(self.network, *inputs)
