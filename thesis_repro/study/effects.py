"""What each switch of the odometry and of the masks does alone: runs that differ from another one in one thing.

The audit (notebook 09) asks this of every slip and of every claim. Rows have the columns of `runner.run`'s summary, so
that `results` and `answer` read both.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import masks, odometry, stages
from thesis_repro.cityscapes import ID, read_label_map
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings, keypoints, metrics
from thesis_repro.odometry.passes import Masks, poses_of
from thesis_repro.study.controls import CORRECTED
from thesis_repro.study.jobs import CONTROL_WIDTH

ESTIMATORS = ("thesis", "inliers", "refined")
FEW = (100, 200, 400)  # keypoints: a twentieth, a tenth and a fifth of the thesis's 2000


# Masks that differ from the thesis's in one thing


class FromLabels:
    """Masks made of each frame's label map by a function of (label map, size): masks[i] for frame i."""

    def __init__(self, folder: Path, sequence: Sequence, make: Callable[[np.ndarray, tuple], np.ndarray]) -> None:
        self.paths = [Path(folder) / path.name for path in sequence.frame_paths]
        self.size, self.make = sequence.size, make

    def __getitem__(self, index: int) -> np.ndarray:
        return self.make(read_label_map(self.paths[index]), self.size)


def enlarged_nearest(label_map: np.ndarray, size: tuple[int, int], dilation_width: int) -> np.ndarray:
    """The thesis's mask, but for the enlargement: Canny on ids that nothing has interpolated (audit row 10)."""
    enlarged = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    return masks.dilate(cv2.Canny(enlarged, masks.CANNY_LOW, masks.CANNY_HIGH), dilation_width)


def without_movable(label_map: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """No boundaries: all of the frame but what can move (Section 5.2 wants keypoints on what does not)."""
    return np.where(masks.forbidden(label_map, size, MaskSettings(movable=0)), np.uint8(0), np.uint8(255))


class AnyKeypoints:
    """Single pixels: so many of a frame's keypoints as masks leave on average, drawn by lot (audit row 28)."""

    def __init__(self, sequence: Sequence, number: int) -> None:
        self.sequence, self.number = sequence, number

    def __getitem__(self, index: int) -> np.ndarray:
        found = keypoints.detect(self.sequence.frame(index), THESIS).astype(int)
        chosen = np.random.default_rng((0, index)).permutation(len(found))[:self.number]
        mask = np.zeros(self.sequence.size, np.uint8)
        mask[found[chosen, 1], found[chosen, 0]] = 255
        return mask


# The runs


@dataclass(frozen=True)
class Plan:
    """What is run on every sequence. orders: of the correspondences, for each switch; chance: for all keypoints."""

    dilation_width: int = CONTROL_WIDTH
    boundaries: str = "canny"
    orders: int = 3
    chance: int = 10
    frames: int | None = None


def measure(kitti: Path, names: Iterable[str], labels: Path, folder: Path, plan: Plan, processes: int = 1
            ) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Every switch on every sequence: (runs, prefixes).

    kitti: the odometry root. labels: a folder with one folder of label maps a sequence. folder: where the tables of
    each sequence are kept; a stopped series goes on where it was.

    runs has a row for each sequence, method, estimator and repetition: errors (those of `metrics.errors`, sim3 in
    metres, `metrics.step_errors`), mean_keypoints and flagged frames. prefixes has the RMSE of all keypoints over the first
    `frames` frames and `metres` of each sequence, a row an order, under the thesis's estimator.
    """
    calls = [joblib.delayed(_measure)(kitti, name, labels / name, folder / name, plan) for name in names]
    work = joblib.Parallel(n_jobs=processes, return_as="generator")(calls)
    tables = list(progress(work, "switches", total=len(calls), unit="sequence"))
    runs, prefixes = (pd.concat([pd.read_csv(path / name, dtype={"sequence": str}) for path in tables],
                                ignore_index=True) for name in ("runs.csv", "prefixes.csv"))
    return runs, prefixes


def _measure(kitti: Path, name: str, labels: Path, folder: Path, plan: Plan) -> Path:
    sequence = Sequence(kitti, name).subset(plan.frames)
    stages.stage(folder, plan=vars(plan), code=stages.code("study/effects"), opencv=cv2.__version__,
                 frames=stages.listing(sequence.frame_paths), poses=stages.content(kitti / "poses" / f"{name}.txt"),
                 labels=stages.listing([labels / path.name for path in sequence.frame_paths]),
                 model=stages.made_from(labels))
    if not (folder / "prefixes.csv").is_file():
        cv2.setNumThreads(1)  # the processes already use every core
        wanted = runs_of(sequence, labels, plan)
        named = {" ".join(map(str, key)): key for key in wanted}
        found = odometry.run_many(sequence, {text: wanted[key] for text, key in named.items()})
        rows = [dict(zip(("method", "estimator", "repetition"), named[text], strict=True)) | _row(result, sequence)
                for text, result in found.items()]
        write_text(folder / "runs.csv", pd.DataFrame(rows).assign(sequence=name).to_csv(index=False))
        rows = [row for (method, estimator, order), text in zip(named.values(), named, strict=True)
                if method == "all" and estimator == "thesis"
                for row in _prefixes(found[text].poses, sequence.poses, order)]
        write_text(folder / "prefixes.csv", pd.DataFrame(rows).assign(sequence=name).to_csv(index=False))
    return folder


def runs_of(sequence: Sequence, labels: Path, plan: Plan
            ) -> dict[tuple[str, str, int], tuple[OdometrySettings, Masks | None]]:
    """The runs over one sequence: {(method, estimator, repetition): (settings, masks)}. labels: of its frames."""
    width, boundaries = plan.dilation_width, plan.boundaries
    own = masks.LabelMasks(labels, sequence, width, boundaries)
    number = round(np.mean([len(keypoints.detect(sequence.frame(index), THESIS, own[index]))
                            for index in range(0, len(sequence), max(1, len(sequence) // 8))]))
    methods: dict[str, tuple[OdometrySettings, Masks | None]] = {
        "all": (THESIS, None),
        "masks": (THESIS, own),
        "filter": (replace(THESIS, mask_mode="filter"), own),
        "nearest": (THESIS, FromLabels(labels, sequence, lambda one, size: enlarged_nearest(one, size, width))),
        "symmetric": (THESIS, masks.LabelMasks(labels, sequence, width, MaskSettings(boundaries, symmetric=True))),
        "corrected": (THESIS, masks.LabelMasks(labels, sequence, width, CORRECTED)),
        "masks, no movable": (THESIS, masks.LabelMasks(labels, sequence, width, MaskSettings(boundaries, movable=0))),
        "no movable": (THESIS, FromLabels(labels, sequence, without_movable)),
        "strongest": (replace(THESIS, max_keypoints=max(1, number)), None),
        "any": (THESIS, AnyKeypoints(sequence, number)),
        **{f"{few} keypoints": (replace(THESIS, max_keypoints=few), None) for few in FEW},
        "orb": (replace(THESIS, detector="orb"), None),
    }
    runs = {}
    for method, (settings, its_masks) in methods.items():
        for order in range(plan.chance if method == "all" else plan.orders):
            for estimator in ESTIMATORS if method in ("all", "masks") else ("thesis", "refined"):
                if order < plan.orders or estimator == "thesis":
                    runs[method, estimator, order] = (replace(settings, estimator=estimator, shuffle_seed=order or None), its_masks)
    return runs


def _row(result: odometry.Result, sequence: Sequence) -> dict[str, Any]:
    poses, true = poses_of(result.frames), sequence.poses
    return {"frames": len(true), **metrics.errors(poses, true), "sim3": metrics.ate(poses, true, "sim3")["rmse"],
            "mean_keypoints": result.frames["detected"].mean(), **metrics.step_errors(poses, true),
            "flagged": int(result.flagged.drop("stationary", errors="ignore").sum())}


def _prefixes(poses: np.ndarray, true: np.ndarray, order: int) -> list[dict[str, Any]]:
    """The RMSE over the first tenth, two tenths, ... of a path."""
    travelled = metrics.travelled(true)
    return [{"repetition": order, "frames": count, "metres": travelled[count - 1],
             "rmse": metrics.rmse(poses[:count], true[:count])}
            for count in np.unique(np.linspace(0, len(true), 11).round().astype(int)) if count >= 5]


# Where keypoints lie, and what can be told from them


def tracks(sequence: Sequence, chosen: dict[str, Masks | None], pairs: int = 6) -> pd.DataFrame:
    """What the keypoints of some frames are worth to the odometry, one row a kind of mask and pair of frames.

    chosen: {name: masks, None for all keypoints}. pairs: frames, spread evenly, that are tracked to the next one.
    Columns: keypoints; residual, the median distance of tracked points from the epipolar lines of the true motion,
    pixels; off, the share of points further away than PySLAM's threshold lets an inlier be, percent; cells, the share
    of the frame's 16 x 5 fields that hold a keypoint, percent; heading, the standard deviation of the direction of
    motion, degrees, that points in these places allow if each is `residual` off.
    """
    rows = []
    limit = THESIS.threshold * sequence.intrinsics[0, 0]
    for index in np.unique(np.linspace(0, len(sequence) - 2, pairs).round().astype(int)):
        before, after = sequence.frame(index), sequence.frame(index + 1)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        if np.linalg.norm(motion[:3, 3]) < metrics.MIN_DIRECTED_STEP:
            continue
        for name, its_masks in chosen.items():
            points = keypoints.detect(before, THESIS, None if its_masks is None else its_masks[int(index)])
            if len(points) < 10:
                continue
            moved, found = keypoints.track(before, after, points)
            distance, heading = _against_truth(points[found], moved[found], motion, sequence.intrinsics)
            residual = float(np.median(np.abs(distance)))
            fields = (points // [sequence.size[1] / 16, sequence.size[0] / 5]).astype(int)
            rows.append({"sequence": sequence.name, "frame": int(index), "keypoints of": name,
                         "keypoints": len(points), "residual": residual,
                         "off": 100 * (np.abs(distance) > limit).mean(),
                         "cells": 100 * len(np.unique(fields, axis=0)) / 80, "heading": heading * residual})
    return pd.DataFrame(rows)


def _against_truth(previous: np.ndarray, current: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
                   ) -> tuple[np.ndarray, float]:
    """(signed distances from the epipolar lines in pixels, degrees that the heading is off for each pixel of noise)."""
    focal = intrinsics[0, 0]
    one, other = (np.column_stack([(points - intrinsics[:2, 2]) / focal, np.ones(len(points))])
                  for points in (previous, current))

    def distances(parameters: np.ndarray) -> np.ndarray:
        turn = cv2.Rodrigues(parameters[:3])[0] @ motion[:3, :3]
        way = motion[:3, 3] / np.linalg.norm(motion[:3, 3])
        way = way + parameters[3] * across + parameters[4] * down
        essential = np.cross(np.eye(3), way) @ turn  # previous camera coordinates of what the current one sees
        lines, back = other @ essential.T, one @ essential
        value = (one * lines).sum(axis=1)
        return focal * value / np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))

    way = motion[:3, 3] / np.linalg.norm(motion[:3, 3])
    across = np.cross([0.0, 1.0, 0.0], way)
    across /= np.linalg.norm(across)
    down = np.cross(way, across)
    start, step = distances(np.zeros(5)), 1e-5
    slopes = np.column_stack([(distances(step * unit) - start) / step for unit in np.eye(5)])
    slopes = slopes[np.abs(start) < 3 * np.median(np.abs(start)) + 0.1]  # what an estimator would call an inlier
    spread = np.linalg.pinv(slopes.T @ slopes)
    return start, float(np.degrees(np.sqrt(spread[3, 3] + spread[4, 4])))


# Label maps


NEAR = 2  # pixels: a boundary this near to an edge has been found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """What Canny on enlarged ids does to the boundaries of one label map (audit rows 10 and 11), in percent.

    lost: boundary pixels of the map enlarged by its nearest neighbours with no edge within NEAR pixels, of all and of
    PAIRS of classes. invented: pixels whose bilinear id is neither that of the nearest neighbour nor of a class that
    lies within NEAR pixels.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    bilinear = cv2.resize(label_map, size[::-1])
    exact = masks.edges(label_map, size, "exact") > 0
    missed = masks.dilate(masks.edges(label_map, size), 2 * NEAR + 1) == 0
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    there = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        there |= (bilinear == number) & (cv2.dilate((nearest == number).astype(np.uint8), around) > 0)
    found = {"lost": 100 * np.nanmean(missed[exact]), "invented": 100 * float((~there).mean())}
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    other = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = {ID[name] for name in pair}
        of_pair = exact & np.isin(nearest, list(ids)) & np.isin(other, list(ids))
        found["/".join(pair)] = 100 * np.nanmean(missed[of_pair]) if of_pair.sum() >= 20 else np.nan
    return found
