"""What commands print: a run's errors and a camera's angles, as JSON's records and as text, and plans."""

import json
from datetime import timedelta

import pandas as pd

from thesis_repro.odometry import metrics
from thesis_repro.odometry.refined import boresight
from thesis_repro.report import texts
from thesis_repro.settings import cores

ERRORS = ("rmse_m", "mae_m", "ate_se3_m", "relative_translation_percent", "relative_rotation_deg_per_m")


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


def run_text(record, sequence, speed=None):
    """The record of a run as lines. speed: metres a second, assumed where there is no truth."""
    return texts.render("run.txt.j2", record=record, sequence=sequence, speed=speed,
                        length=metrics.RELATIVE_LENGTH).rstrip()


def angles(rotation, table):
    """The record of `boresight.estimate` (degrees) and of the table of `boresight.explained` (metres and degrees)."""
    return {"angles": _records(_intervals(rotation)), "steps": rotation.steps,
            "sequences": _records(table.set_index("sequence"))}


def angles_text(rotation, table):
    """The same as lines."""
    return f"""{_intervals(rotation).to_string(float_format="{:+.3f}".format, na_rep="-")}
from {rotation.steps} steps

Each sequence: angles in degrees with their intervals; RMSE in metres as it is, with its own angles, and with those of
the others of its recording day; sway, how much the sideways direction of motion varies on straight steps, in degrees
{table.set_index("sequence").T.to_string(float_format="{:.3f}".format, na_rep="-")}"""


def _intervals(rotation):
    return pd.DataFrame({"degrees": rotation.angles, "low": rotation.low, "high": rotation.high}, boresight.ANGLES)


def _records(table):
    return json.loads(table.to_json(orient="index", double_precision=15))  # which has null where a number is missing


def plan_text(plan):
    """A plan of `study.plan` as lines."""
    return texts.render("plan.txt.j2", plan=plan, cores=cores(),
                        duration=lambda seconds: timedelta(seconds=round(seconds))).rstrip()
