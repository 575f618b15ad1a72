"""What commands print of a run's errors and a camera's angles: the records of JSON and of templates."""

import json

import pandas as pd

from thesis_repro.odometry import metrics
from thesis_repro.odometry.refined import boresight

ERRORS = ("rmse_m", "mae_m", "ate_se3_m", "relative_translation_percent", "relative_rotation_deg_per_100m")


def run(result, sequence, alignment):
    """The record of an `odometry.Result`: errors by name (None without truth and on too short a path), keypoints, time
    and flags."""
    errors = dict.fromkeys(ERRORS)
    if sequence.has_truth:
        values = metrics.errors(result.poses, sequence.poses, alignment).values()
        errors = {name: None if value != value else value for name, value in zip(ERRORS, values, strict=True)}
    detected = result.frames["detected"].dropna()  # none where every frame is without structure
    seconds = result.frames.filter(like="_seconds").sum(axis=1)
    return {"sequence": sequence.name, "frames": len(sequence), **errors,
            "mean_keypoints": float(detected.mean()) if len(detected) else 0.0,
            "ms_per_frame": 1000 * float(seconds.mean()),
            "flagged": {flag: int(count) for flag, count in result.flagged.items()}}


def angles(rotation, table):
    """The record of `boresight.estimate` (degrees) and of the table of `boresight.explained` (metres and degrees)."""
    intervals = pd.DataFrame({"degrees": rotation.angles, "low": rotation.low, "high": rotation.high}, boresight.ANGLES)
    return {"angles": _records(intervals), "steps": rotation.steps, "sequences": _records(table.set_index("sequence"))}


def _records(table):
    return json.loads(table.to_json(orient="index", double_precision=15))  # which has null where a number is missing
