#!/usr/bin/env python3
"""SAM 2 and 2.1 for single images: an encoder of the image and a decoder of masks from prompts."""

from pathlib import Path

import numpy as np
import torch

import common
from common import Graph

SIDE = 1024
RULE = {"size": [SIDE, SIDE], **common.IMAGENET}
FEATURES = ["high_res_0", "high_res_1", "embedding"]
PROMPTS = ["point_coords", "point_labels", "mask_input", "has_mask_input"]
OUTPUTS = ["masks", "scores"]
# Side of the masks that the decoder takes and gives.
MASK = 256


def encode(network, image):
    """What the decoder needs of an image, from fine to coarse."""
    fine, middle, coarse = network.forward_image(image)["backbone_fpn"][-3:]
    if network.directly_add_no_mem_embed:
        # An image by itself remembers nothing.
        coarse = coarse + network.no_mem_embed.reshape(1, -1, 1, 1)
    return fine, middle, coarse


def decode(network, fine, middle, coarse, points, labels, mask=None, has_mask=None):
    """Three masks as logits and how good each is; points and the corners of boxes alike are `points`."""
    sparse, dense = network.sam_prompt_encoder(points=(points, labels), boxes=None, masks=mask)
    if has_mask is not None:
        # Without a mask its embedding is a learned one. The graph has both and takes one.
        without = network.sam_prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1)
        dense = torch.where(has_mask.reshape(1, 1, 1, 1) > 0.5, dense, without.expand_as(dense))
    masks, scores, _, _ = network.sam_mask_decoder(
        image_embeddings=coarse,
        image_pe=network.sam_prompt_encoder.get_dense_pe(),
        sparse_prompt_embeddings=sparse,
        dense_prompt_embeddings=dense,
        multimask_output=True,
        repeat_image=False,
        high_res_features=[fine, middle],
    )
    return masks, scores


def position_embedding(self, sides):
    """The encoder's embedding of positions, with sizes that are numbers: traced ones leave shapes that ONNX
    Runtime warns of when it loads the file."""
    rows, columns = (int(side) for side in sides)
    windows = self.pos_embed_window
    repeated = windows.repeat(1, 1, rows // int(windows.shape[2]), columns // int(windows.shape[3]))
    coarse = torch.nn.functional.interpolate(self.pos_embed, size=(rows, columns), mode="bicubic")
    return (coarse + repeated).permute(0, 2, 3, 1)


def predicted(predictor, image):
    """What upstream's own predictor keeps of an image, which is made already."""
    predictor._transforms = lambda _: image[0]
    predictor.set_image(np.zeros((SIDE, SIDE, 3), np.uint8))
    kept = predictor._features
    return [*kept["high_res_feats"], kept["image_embed"]]


def run():
    parser = common.arguments(
        __doc__,
        "export_sam2.py --repo sam2 --config configs/sam2.1/sam2.1_hiera_s.yaml --checkpoint "
        "sam2.1_hiera_small.pt --images clip -o sam2_small\n  writes sam2_small.encoder.onnx and "
        "sam2_small.decoder.onnx",
        repo="the clone of sam2",
    )
    parser.add_argument("--config", default="configs/sam2.1/sam2.1_hiera_t.yaml", metavar="NAME",
                        help="the checkpoint's configuration, within the clone's folder sam2 [default: "
                        "configs/sam2.1/sam2.1_hiera_t.yaml]")
    parser.add_argument("-o", "--output", required=True, metavar="NAME",
                        help="writes NAME.encoder.onnx and NAME.decoder.onnx")
    given = common.parse(parser)

    common.enter(given.repo, "sam2/build_sam.py", f"sam2/{given.config}")
    building = common.load("sam2.build_sam")
    predicting = common.load("sam2.sam2_image_predictor")
    model = building.build_sam2(given.config, None, device="cpu", apply_postprocessing=False)
    if given.random_weights:
        common.randomise(model, given.seed)
    else:
        common.fill(model, common.read_checkpoint(given.checkpoint, ["model"]), given.checkpoint)

    paths = common.files(given.images, 2)
    pictures = [common.picture(path, (SIDE, SIDE), RULE) for path in paths]
    with torch.no_grad():
        predictor = predicting.SAM2ImagePredictor(model)
        features = [predicted(predictor, picture) for picture in pictures]

        # A point alone; two points, a box and a mask.
        one = (torch.tensor([[[410.0, 530.0]]]), torch.tensor([[1.0]]))
        first = decode(model, *features[0], *one)
        best = first[0][:, first[1].argmax()][:, None].contiguous()
        corners = [[300.0, 420.5], [700.0, 120.0], [250.0, 200.0], [800.0, 900.0]]
        four = (torch.tensor([corners]), torch.tensor([[1.0, 0.0, 2.0, 3.0]]))
        second = decode(model, *features[1], *four, best)
    no_mask, yes, no = torch.zeros(1, 1, MASK, MASK), torch.ones(1), torch.zeros(1)

    base = Path(given.output)
    paths_out = [base.with_name(f"{base.name}.{part}.onnx") for part in ("encoder", "decoder")]
    encoder = Graph(
        paths_out[0],
        common.Wrapped(model, encode),
        ["image"],
        FEATURES,
        {"kind": "mask_encoder", "version": common.VERSION, "input": "image", "picture": RULE, "outputs": FEATURES},
        [(path.name, (picture,)) for path, picture in zip(paths, pictures)],
        [common.arrays(tensors) for tensors in features],
    )
    decoder = Graph(
        paths_out[1],
        common.Wrapped(model, decode),
        FEATURES + PROMPTS,
        OUTPUTS,
        {
            "kind": "mask_decoder",
            "version": common.VERSION,
            "features": FEATURES,
            **dict(zip(["points", "labels", "mask_input", "has_mask"], PROMPTS)),
            **{output: output for output in OUTPUTS},
        },
        [
            ("1 point", (*features[0], *one, no_mask, no)),
            ("2 points, a box, a mask", (*features[1], *four, best, yes)),
        ],
        [common.arrays(first), common.arrays(second)],
        {"point_coords": {1: "prompts"}, "point_labels": {1: "prompts"}},
    )
    common.write(
        [encoder, decoder],
        given.opset,
        (type(model.image_encoder.trunk), "_get_pos_embed", position_embedding),
        # Of one image nothing is repeated; ONNX would count the repetitions when it runs.
        (torch, "repeat_interleave", lambda x, repeats, dim=None: x),
    )


if __name__ == "__main__":
    common.main(run)
