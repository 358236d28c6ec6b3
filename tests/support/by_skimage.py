"""What scikit-image measures of images, for tests/table.rs.

Reads a JSON list of cases on standard input and writes one of results, in the same order. A case is a `sheet`, a PNG
with the truth, the image and their difference side by side, or a `truth` and a `picture`, files of 32-bit floats of a
`shape`; with a `mask`, a PNG, PSNR and SSIM of the pixels that are white there come along as `masked_psnr` and
`masked_ssim`.
"""

import json
import sys

import numpy as np
from skimage.io import imread
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

# Beyond the border there are zeros for SSIM's window of 11 pixels; scikit-image itself mirrors the image there.
BORDER = 5


def load(case):
    if "sheet" in case:
        sheet = imread(case["sheet"]) / 255.0
        width = sheet.shape[1] // 3
        return sheet[:, :width], sheet[:, width : 2 * width]
    read = lambda name: np.fromfile(case[name], "<f4").reshape(case["shape"]).astype(float).clip(0, 1)
    return read("truth"), read("picture")


def similarity(truth, picture):
    around = ((BORDER, BORDER), (BORDER, BORDER), (0, 0))
    _, whole = structural_similarity(
        np.pad(truth, around),
        np.pad(picture, around),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return whole[BORDER:-BORDER, BORDER:-BORDER]


def measure(case):
    truth, picture = load(case)
    of_pixels = similarity(truth, picture)
    found = {"psnr": peak_signal_noise_ratio(truth, picture, data_range=1.0), "ssim": of_pixels.mean()}
    if "mask" in case:
        chosen = imread(case["mask"]) > 127
        found["masked_psnr"] = peak_signal_noise_ratio(truth[chosen], picture[chosen], data_range=1.0)
        found["masked_ssim"] = of_pixels[chosen].mean()
    return {key: float(value) for key, value in found.items()}


json.dump([measure(case) for case in json.load(sys.stdin)], sys.stdout)
