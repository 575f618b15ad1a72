"""The steps on which masks fail.

They are seen from how many keypoints the masks keep, and how well these determine the motion.
"""

from dataclasses import replace

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from keypoint_study.report import style
from thesis_repro.odometry import THESIS, Matches, Odometry, metrics
from thesis_repro.odometry.estimators import refined
from thesis_repro.odometry.refined.fit import SUPPORT_THRESHOLDS, near, with_uncertainty

SETTINGS = replace(THESIS, estimator=refined)
KINDS = {"all": ("all keypoints", style.BASELINE), "masks": ("masks", style.MASKED)}
CELLS = 4  # columns and rows into which a frame is divided
# degrees between the rotation errors of a step with masks and with all keypoints
CLEAR_DIFFERENCE = 0.15
# edges for the number of keypoints that agree with the motion
BINS = (0, 100, 200, 300, 500, 10**6)
PANELS = {
    "agreeing": "agreeing\nkeypoints",
    "direction_std": "uncertainty of\ndirection (degrees)",
    "rotation_error": "rotation error\n(degrees)",
}


def measure(sequence, masks):
    """Return one row for each step of a kitti.Sequence and kind of keypoints, refined estimator.

    The kinds are "all" and "masks". tracked: number of keypoints. agreeing: number of keypoints
    that agree with the motion from all keypoints (the best known motion). cells: share of 4x4 cells
    that contain a tracked keypoint. spread_u, spread_v: standard deviations of the tracked
    keypoints, pixels. depth_spread: upper over lower quartile of the depths of the agreeing
    keypoints. condition, direction_std: condition of their normal equations, and uncertainty of the
    direction of motion, degrees. rotation_error: of the estimate, degrees. flag: texts of its
    flags.
    """
    rows = []
    scale = sequence.scales
    cell = [sequence.size[1] / CELLS, sequence.size[0] / CELLS]
    for index, steps in _steps(sequence, masks, range(len(sequence))):
        reference = steps["all"].motion
        lost = any(step.motion.rotation is None for step in steps.values())
        if lost or scale[index] <= SETTINGS.scale_gate:
            continue
        true = np.linalg.inv(sequence.poses[index - 1]) @ sequence.poses[index]
        for kind, step in steps.items():
            agreeing = _agreeing(step, reference)
            current, previous = step.matches.current[agreeing], step.matches.previous[agreeing]
            matches = Matches(current, previous, SETTINGS.threshold)
            fit = with_uncertainty(reference.rotation, reference.translation, matches)
            cells = (step.previous // cell).astype(int)
            rows.append(
                {
                    "sequence": sequence.name,
                    "frame": index,
                    "kind": kind,
                    "tracked": len(step.current),
                    "agreeing": int(agreeing.sum()),
                    "cells": len(np.unique(cells, axis=0)) / CELLS**2,
                    "spread_u": step.previous[:, 0].std(),
                    "spread_v": step.previous[:, 1].std(),
                    "depth_spread": _depth_spread(current, previous, reference),
                    "condition": fit.condition,
                    "direction_std": fit.heading_std_deg,
                    "rotation_error": metrics.angles(true[:3, :3].T @ step.motion.rotation),
                    "flag": "; ".join(step.flags),
                }
            )
    return pd.DataFrame(rows)


def _steps(sequence, masks, indices):
    """Yield (frame index, {kind: step}) for consecutive frames of a sequence."""
    odometries = {kind: Odometry(sequence.intrinsics, SETTINGS) for kind in KINDS}
    scale = sequence.scales
    for index in indices:
        frame = sequence.frame(index)
        frame_masks = {"all": None, "masks": masks[index]}
        steps = {}
        for kind, odometry in odometries.items():
            steps[kind] = odometry.step(frame, scale[index], frame_masks[kind])
        yield index, steps


def _agreeing(step, motion):
    """Return which of a step's matches are near the epipolar lines of a motion."""
    limit = SUPPORT_THRESHOLDS * SETTINGS.threshold
    return near(motion.rotation, motion.translation, step.matches, limit)


def _depth_spread(current, previous, motion):
    """Return upper over lower quartile of the depths of matched points in front of the camera."""
    projection = np.column_stack([motion.rotation, motion.translation])
    points = cv2.triangulatePoints(np.eye(3, 4), projection, current.T, previous.T)
    ahead = points[2] * points[3] > 0
    if not ahead.any():
        return np.nan
    upper, lower = np.percentile(points[2, ahead] / points[3, ahead], [75, 25])
    return upper / lower


def table(steps):
    """Return the medians with all keypoints and with masks.

    They are by sequence and by number of agreeing keypoints.
    """
    wide = steps.pivot(index=["sequence", "frame"], columns="kind").reset_index(level="sequence")
    by_number = pd.cut(wide["agreeing", "masks"], BINS, right=False).map(_name_bin)
    rows = []
    for name, group in [*wide.groupby("sequence"), *wide.groupby(by_number, observed=True)]:
        row = {"steps": name, "number": len(group)}
        for column in steps.columns[3:-1]:
            for kind, (label, _) in KINDS.items():
                row[f"{column}, {label}"] = float(f"{group[column, kind].median():.3g}")
        worse = group["rotation_error", "masks"] - group["rotation_error", "all"]
        row[f"masks worse by {CLEAR_DIFFERENCE} degrees"] = int((worse > CLEAR_DIFFERENCE).sum())
        row[f"masks better by {CLEAR_DIFFERENCE} degrees"] = int((worse < -CLEAR_DIFFERENCE).sum())
        row["flagged, masks"] = int((group["flag", "masks"] != "").sum())
        rows.append(row)
    return pd.DataFrame(rows)


def _name_bin(bin):
    """Return the text for an interval of BINS."""
    if bin.right == BINS[-1]:
        return f"{bin.left} or more"
    return f"{bin.left} to {bin.right - 1} agreeing"


def figure(steps, sequences, masks):
    """Draw the worst step, and below it, frame by frame, the measures of the two worst sequences.

    sequences, masks: lists of equal length. The worst sequences are those whose mean rotation error
    masks raise most. The worst step is the one of the first of these sequences whose rotation error
    masks raise most.
    """
    error = steps.pivot(index=["sequence", "frame"], columns="kind", values="rotation_error")
    means = error.groupby("sequence").mean()
    names = list((means["masks"] / means["all"]).sort_values(ascending=False).index[:2])
    index = (error["masks"] - error["all"])[names[0]].idxmax()
    worst = [sequence.name for sequence in sequences].index(names[0])
    axes = plt.figure(figsize=(style.PAGE_WIDTH, 7), layout="constrained").subplot_mosaic(
        [["drawing"] * len(names), *([f"{column} {name}" for name in names] for column in PANELS)],
        height_ratios=[2.0, 1, 1, 1],
    )
    _draw(axes["drawing"], sequences[worst], masks[worst], index)
    for name in names:
        for column, label in PANELS.items():
            panel = axes[f"{column} {name}"]
            for kind, (text, color) in KINDS.items():
                rows = steps[(steps["sequence"] == name) & (steps["kind"] == kind)]
                panel.plot(
                    rows["frame"],
                    rows[column].where(rows[column] > 0),
                    color=color,
                    label=text,
                    linewidth=1,
                )
            for frame in rows.loc[rows["flag"] != "", "frame"]:
                panel.axvspan(
                    frame - 0.5,
                    frame + 0.5,
                    color=style.ORANGE,
                    alpha=0.3,
                    linewidth=0,
                    label="flag: ambiguous motion",
                )
            if name == names[0]:
                panel.set_ylabel(label)
            panel.tick_params(labelsize=7)
            drawn = np.concatenate([line.get_ydata() for line in panel.lines])
            style.ratio_axis(panel.yaxis, drawn)
        axes[f"agreeing {name}"].set_title(f"sequence {name}")
        panel.set_xlabel("frame")
    style.legend_below(axes["drawing"].figure, list(axes.values()), 4)
    return axes["drawing"].figure


def _draw(panel, sequence, masks, index):
    """Draw the keypoints before a step: dropped by the mask, or kept and agreeing or not."""
    _, (_, steps) = _steps(sequence, masks, (index - 1, index))
    motion, mask = steps["all"].motion, masks[index - 1]
    agreeing = _agreeing(steps["masks"], motion)
    columns, rows = np.rint(steps["all"].previous).astype(int).T
    for points, color, size, label in (
        (steps["all"].previous[mask[rows, columns] == 0], "#bbbbbb", 2, "dropped by the mask"),
        (steps["masks"].previous[agreeing], style.GREEN, 7, "kept, agrees with the motion"),
        (steps["masks"].previous[~agreeing], style.RED, 7, "kept, does not agree"),
    ):
        panel.plot(
            *points.T, "o", color=color, markersize=size**0.5, markeredgewidth=0, label=label
        )
    for outline in cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0]:
        panel.plot(*np.vstack([outline[:, 0], outline[:1, 0]]).T, color="black", linewidth=0.4)
    epipole = sequence.intrinsics @ motion.translation
    panel.plot(
        *(epipole[:2] / epipole[2]),
        "+",
        color="black",
        markersize=11,
        label="epipole: where the car goes",
    )
    panel.set(
        xlim=(0, sequence.size[1]),
        ylim=(sequence.size[0], 0),
        aspect="equal",
        xticks=[],
        yticks=[],
        title=f"sequence {sequence.name}, frames {index - 1} to {index}: {agreeing.sum()} of {len(agreeing)} "
        f"keypoints in the mask agree with the motion",
    )
