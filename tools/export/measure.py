#!/usr/bin/env python3
"""Time and memory of an exported file by the ONNX Runtime on the processor, on noise.

    measure.py FILE [--size 512x288] [--threads 2] [--runs 5]

Sides are taken to the multiples that the file's contract asks for. Prints one line: seconds of a run (the median,
without the first) by the clock and of the processors' time, which other work on the machine changes less; the peak
of resident memory; the size of the file.
"""

import argparse
import json
import math
import resource
import statistics
import time
from pathlib import Path

import numpy as np
import onnxruntime

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("file", type=Path)
parser.add_argument("--size", default="512x288", metavar="WxH")
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--runs", type=int, default=5)
given = parser.parse_args()

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = given.threads
options.log_severity_level = 3
# Threads that wait by turning round would count as work.
options.add_session_config_entry("session.intra_op.allow_spinning", "0")
session = onnxruntime.InferenceSession(str(given.file), options, providers=["CPUExecutionProvider"])
contract = json.loads(session.get_modelmeta().custom_metadata_map["splat4d"])
multiple = contract.get("picture", {}).get("multiple", 1)
# Axes are known by their names: of images height and width, of prompts a few.
width, height = (math.ceil(int(side) / multiple) * multiple for side in given.size.split("x"))
free = {"height": height, "width": width, "prompts": 2}
noise = np.random.default_rng(0)
feed = {
    taken.name: noise.random([side if isinstance(side, int) else free[side] for side in taken.shape], np.float32)
    for taken in session.get_inputs()
}
seconds, work = [], []
for _ in range(given.runs + 1):
    start, worked = time.perf_counter(), time.process_time()
    session.run(None, feed)
    seconds.append(time.perf_counter() - start)
    work.append(time.process_time() - worked)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
shape = next(iter(feed.values())).shape
print(f"{given.file.name}: {'x'.join(map(str, shape))}, {statistics.median(seconds[1:]):.2f} s, "
      f"of processors {statistics.median(work[1:]):.2f} s, "
      f"{peak:.0f} MiB at most, file {given.file.stat().st_size / 2**20:.1f} MiB")
