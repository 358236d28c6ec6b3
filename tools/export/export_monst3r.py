#!/usr/bin/env python3
"""MonST3R and DUSt3R: an encoder of one image and a decoder of the points of two images, in the first's frame."""

from math import inf
from pathlib import Path

import torch

import common
from common import Graph, Mistake

PATCH = 16
RULE = {"fit": "crop", "mean": [0.5] * 3, "deviation": [0.5] * 3}
TOKENS = ["tokens_1", "tokens_2"]
POINTS = ["points_1", "points_2"]
CONFIDENCE = ["confidence_1", "confidence_2"]
# The architecture of the checkpoints ViTLarge_BaseDecoder_512_dpt, of DUSt3R and MonST3R alike.
LARGE = {
    "pos_embed": "RoPE100",
    "patch_embed_cls": "ManyAR_PatchEmbed",
    "img_size": (512, 512),
    "head_type": "dpt",
    "output_mode": "pts3d",
    "depth_mode": ("exp", -inf, inf),
    "conf_mode": ("exp", 1, inf),
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
}


def rotation(rows, columns, base):
    """The turning of queries and keys by their places in the grid, in place of upstream's.

    Its angles are constants of the graph: upstream reads the number of places from a tensor, and its variant for
    CUDA is no operator that ONNX knows. Half of the channels turn by the row, half by the column; in each, a
    channel of the first half is turned with one of the second.
    """
    places = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).float()

    def turn(_, tokens, positions):
        batch, heads, count, channels = tokens.shape
        pairs = channels // 4
        speeds = base ** (-torch.arange(pairs, dtype=torch.float32) / pairs)
        angles = places[:, :, None] * speeds
        cos, sin = angles.cos(), angles.sin()
        apart = tokens.reshape(batch, heads, count, 2, 2, pairs)
        first, second = apart[..., 0, :], apart[..., 1, :]
        turned = torch.stack((first * cos - second * sin, second * cos + first * sin), dim=-2)
        return turned.reshape(batch, heads, count, channels)

    return turn


def encode(network, image):
    """The tokens of a landscape image, without upstream's sorting of a batch into landscape and portrait."""
    embedding = network.patch_embed
    tokens = embedding.norm(embedding.proj(image).flatten(2).transpose(1, 2))
    for block in network.enc_blocks:
        tokens = block(tokens, None)
    return (network.enc_norm(tokens),)


def decoder(height, width):
    """Points and confidence of two images from their tokens."""

    def decode(network, first, second):
        layers = network._decoder(first, None, second, None)
        heads = (network.downstream_head1, network.downstream_head2)
        given = [head(list(tokens), (height, width)) for head, tokens in zip(heads, layers)]
        return (*(one["pts3d"] for one in given), *(one["conf"] for one in given))

    return decode


def upstream(network, first, second):
    """What the network itself says of two images: as the decoder's outputs, and the tokens of both."""
    shape = torch.tensor([first.shape[-2:]])
    views = [{"img": picture, "true_shape": shape, "instance": [str(i)]} for i, picture in enumerate((first, second))]
    one, two = network(*views)
    points = [one["pts3d"], two["pts3d_in_other_view"]]
    tokens = [network._encode_image(picture, shape)[0] for picture in (first, second)]
    return (*points, *(v["conf"] for v in (one, two))), tokens


def run():
    parser = common.arguments(
        __doc__,
        "export_monst3r.py --repo monst3r --checkpoint MonST3R_PO-TA-S-W_ViTLarge_BaseDecoder_512_dpt.pth "
        "--images clip --size 512x288 -o monst3r\n  writes monst3r.encoder.onnx and monst3r.decoder.onnx",
        repo="the clone of monst3r or dust3r, with its submodule croco",
    )
    parser.add_argument("--size", type=common.size, default=(512, 288), metavar="WxH",
                        help="the images' size, landscape, multiples of 16; the longer side 512 [default: 512x288]")
    parser.add_argument("-o", "--output", required=True, metavar="NAME",
                        help="writes NAME.encoder.onnx and NAME.decoder.onnx")
    given = common.parse(parser)
    width, height = given.size
    if width % PATCH or height % PATCH or width < height:
        raise Mistake(f"--size {width}x{height}: a landscape size of multiples of {PATCH} is needed")

    common.enter(given.repo, "dust3r/model.py")
    if not (given.repo / "croco/models/croco.py").is_file():
        raise Mistake(f"--repo {given.repo}: its submodule croco is missing; `git submodule update --init` brings it")
    # MonST3R's code imports its optical flow and its evaluation together with the network.
    common.placeholder("third_party")
    common.placeholder("third_party.raft", "load_RAFT")
    common.placeholder("dust3r.utils.vo_eval", "save_trajectory_tum_format")
    model = common.load("dust3r.model").AsymmetricCroCo3DStereo(**LARGE).eval()
    if given.random_weights:
        common.randomise(model, given.seed)
    else:
        state = common.read_checkpoint(given.checkpoint, ["model"])
        if not any(key.startswith("dec_blocks2.") for key in state):
            # Weights from before training on points: both decoders begin with the same.
            state |= {key.replace("dec_blocks.", "dec_blocks2."): state[key] for key in state if "dec_blocks." in key}
        # The token of hidden patches is for pretraining only.
        common.fill(model, state, given.checkpoint, ["mask_token"])

    paths = common.files(given.images, 3)
    pictures = [common.picture(path, given.size, RULE) for path in paths]
    with torch.no_grad():
        pairs = [upstream(model, *pictures[i : i + 2]) for i in range(2)]

    base = Path(given.output)
    encoder_path, decoder_path = (base.with_name(f"{base.name}.{part}.onnx") for part in ("encoder", "decoder"))
    tokens = [*pairs[0][1], pairs[1][1][1]]
    encoder = Graph(
        encoder_path,
        common.Wrapped(model, encode),
        ["image"],
        ["tokens"],
        {
            "kind": "pointmap_encoder",
            "version": common.VERSION,
            "input": "image",
            "picture": {"size": [width, height], **RULE},
            "output": "tokens",
        },
        [(path.name, (picture,)) for path, picture in zip(paths, pictures)],
        [common.arrays([one]) for one in tokens],
    )
    pair_decoder = Graph(
        decoder_path,
        common.Wrapped(model, decoder(height, width)),
        TOKENS,
        POINTS + CONFIDENCE,
        {"kind": "pointmap_decoder", "version": common.VERSION, "inputs": TOKENS, "points": POINTS, "confidence": CONFIDENCE},
        [(f"{paths[i].name} and the next", tuple(tokens[i : i + 2])) for i in range(2)],
        [common.arrays(outputs) for outputs, _ in pairs],
    )
    turn = rotation(height // PATCH, width // PATCH, getattr(model.rope, "base", 100.0))
    common.write(
        [encoder, pair_decoder],
        given.opset,
        (type(model.rope), "forward", turn),
        # ONNX has no exp(x) − 1. This form of it is exact near 0, too.
        (torch, "expm1", lambda x: torch.tanh(x / 2) * (torch.exp(x) + 1)),
    )


if __name__ == "__main__":
    common.main(run)
