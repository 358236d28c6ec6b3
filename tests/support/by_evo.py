"""What the evo package measures, for tests/evo.rs and tests/table.rs.

Reads a JSON list of cases on standard input and writes one of results, in the same order: for each of the
four errors its statistics, or null where evo measures none.
"""

import copy
import json
import sys
from pathlib import Path

import numpy as np
from evo import EvoException
from evo.core import metrics, sync
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from evo.main_ape import ape
from evo.main_rpe import rpe
from evo.tools import file_interface



def read_sintel(folder):
    """The .cam files of a folder in the order of their names: a tag, K and the world-to-camera matrix, row by row."""
    poses = []
    for path in sorted(Path(folder).glob("*.cam")):
        view_from_world = np.eye(4)
        view_from_world[:3] = np.frombuffer(path.read_bytes(), "<f8", 12, 4 + 9 * 8).reshape(3, 4)
        poses.append(np.linalg.inv(view_from_world))
    return PosePath3D(poses_se3=poses)


READERS = {
    "tum": file_interface.read_tum_trajectory_file,
    "kitti": file_interface.read_kitti_poses_file,
    "euroc": file_interface.read_euroc_csv_trajectory,
    "sintel": read_sintel,
}
UNITS = {"frames": Unit.frames, "metres": Unit.meters, "degrees": Unit.degrees}
TRANSLATION = metrics.PoseRelation.translation_part
ROTATION = metrics.PoseRelation.rotation_angle_deg
files = {}


def read(kind, path):
    if path not in files:
        files[path] = READERS[kind](path)
    return copy.deepcopy(files[path])


def measure(case):
    reference = read(case["reference_format"], case["reference"])
    estimate = read(case["estimate_format"], case["estimate"])
    if case["timed"]:
        reference, estimate = sync.associate_trajectories(
            reference, estimate, max_diff=case["max_time_diff"], offset_2=case["time_offset"]
        )
    align = {
        "align": case["align"] in ("se3", "sim3"),
        "correct_scale": case["align"] in ("scale", "sim3"),
        "align_origin": case["align"] == "origin",
        "n_to_align": case["align_first"] or -1,
    }
    relative = {
        "delta": case["rpe_delta"],
        "delta_unit": UNITS[case["rpe_unit"]],
        "rel_delta_tol": case["rpe_tolerance"],
        "all_pairs": case["rpe_all_pairs"],
        "pairs_from_reference": case["rpe_along_reference"],
    }

    def statistics(of, relation, **how):
        both = copy.deepcopy(reference), copy.deepcopy(estimate)
        try:
            found = of(*both, relation, **how, **align)
        except EvoException as error:
            print(f"{case['name']}: {error}", file=sys.stderr)
            return None
        return {key: float(value) for key, value in found.stats.items()}

    return {
        "poses": reference.num_poses,
        "ape_trans": statistics(ape, TRANSLATION),
        "ape_rot_deg": statistics(ape, ROTATION),
        "rpe_trans": statistics(rpe, TRANSLATION, **relative),
        "rpe_rot_deg": statistics(rpe, ROTATION, **relative),
    }


json.dump([measure(case) for case in json.load(sys.stdin)], sys.stdout)
