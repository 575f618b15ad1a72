"""Ablations: what each switch of the odometry and of the masks does alone (notebook 09).

Every run differs from a reference run in one thing. The tables have the columns of `runner.run`, so that `compare`
reads them too.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import longrun, masks, odometry, stages
from thesis_repro.cityscapes import ID, read_label_map
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings, keypoints, metrics
from thesis_repro.odometry.passes import Masks
from thesis_repro.study.compare import LEVEL
from thesis_repro.study.controls import CORRECTED
from thesis_repro.study.jobs import CONTROL_WIDTH
from thesis_repro.study.runner import measures

Runs = dict[tuple[str, str, int], tuple[OdometrySettings, Masks | None]]  # by method, estimator, repetition
ESTIMATORS = ("thesis", "inliers", "refined")
REPETITIONS, BASELINE_REPETITIONS = 3, 8  # of every method, and of all keypoints under the thesis's estimator
VEGETATION = (ID["vegetation"], ID["terrain"])
FEW_KEYPOINTS = (100, 200, 400)  # a twentieth, a tenth and a fifth of the thesis's 2000


# Masks that differ from the thesis's in one thing


class MadeMasks:
    """Masks made by a function of the frame's number: masks[i] for frame i."""

    def __init__(self, make: Callable[[int], np.ndarray]) -> None:
        self.make = make

    def __getitem__(self, index: int) -> np.ndarray:
        return self.make(index)


def without_classes(ids: Iterable[int], label_map: np.ndarray) -> np.ndarray:
    """No boundaries: all of the frame but some classes (Section 5.2.2: trees and bushes)."""
    return np.where(np.isin(label_map, list(ids)), np.uint8(0), np.uint8(255))


def random_keypoints(sequence: Sequence, amount: int | float, index: int) -> np.ndarray:
    """A mask of single pixels: some of a frame's keypoints, drawn at random: a number (int), or a share (float)."""
    points = keypoints.detect(sequence.frame(index), THESIS).astype(int)
    number = amount if isinstance(amount, int) else round(amount * len(points))
    chosen = np.random.default_rng((0, index)).permutation(len(points))[:number]
    mask = np.zeros(sequence.size, np.uint8)
    mask[points[chosen, 1], points[chosen, 0]] = 255
    return mask


# The runs


def measure(kitti: Path, names: Iterable[str], labels: Path, folder: Path, *, frames: int | None = None,
            processes: int = 1, **options: Any) -> pd.DataFrame:
    """Run every ablation on every sequence; returns a table with one row a run.

    kitti: the odometry root. labels: a folder with one folder of label maps a sequence. folder: keeps the runs of each
    sequence, so that a stopped call goes on where it was. frames: of each sequence, None for all.
    options: of `runs_of`.

    Columns: sequence, method, estimator, repetition, those of `runner.measures`, and sim3 (RMSE in metres after an
    alignment that may scale).
    """
    calls = [joblib.delayed(_measure)(kitti, name, labels / name, folder / name, frames, options) for name in names]
    work = joblib.Parallel(n_jobs=processes, return_as="generator", initializer=longrun.end_with_parent)(calls)
    paths = list(progress(work, "ablations", total=len(calls), unit="sequence"))
    return pd.concat([pd.read_csv(path, dtype={"sequence": str}) for path in paths], ignore_index=True)


def _measure(kitti: Path, name: str, labels: Path, folder: Path, frames: int | None, options: dict[str, Any]) -> Path:
    sequence = Sequence(kitti, name).subset(frames)
    stages.stage(folder, options=options, code=stages.code("study/ablations"),
                 **stages.made_with("opencv-python-headless", "numpy", "numba"),
                 sequence=stages.listing(sequence.files),
                 labels=stages.listing([labels / path.name for path in sequence.frame_paths]),
                 model=stages.made_from(labels))
    path = folder / "runs.csv"
    if stages.kept_table(path) is None:
        cv2.setNumThreads(1)  # the processes already use every core
        runs = runs_of(sequence, labels, **options)
        results = odometry.run_many(sequence, {" ".join(map(str, key)): run for key, run in runs.items()})
        rows = [{"method": method, "estimator": estimator, "repetition": repetition}
                | measures(result.frames, sequence.poses)
                | {"sim3": metrics.ate(result.poses, sequence.poses, "sim3")["rmse"]}
                for (method, estimator, repetition), result in zip(runs, results.values(), strict=True)]
        write_text(path, pd.DataFrame(rows).assign(sequence=name).to_csv(index=False))
    return path


def runs_of(sequence: Sequence, labels: Path, *, repetitions: int = REPETITIONS,
            baseline_repetitions: int = BASELINE_REPETITIONS, dilation_width: int = CONTROL_WIDTH) -> Runs:
    """The runs over one sequence: {(method, estimator, repetition): (settings, masks)}. labels: of its frames.

    "baseline" (all keypoints) and "masked" are run under each of ESTIMATORS, the others under the thesis's and the
    refined one. A repetition other than 0 is the seed that shuffles the matched points. All keypoints have
    `baseline_repetitions` under the thesis's estimator, from which `null_distribution` draws.
    """
    from_labels = partial(masks.LabelMasks, labels, sequence, dilation_width)

    def enlarged(index: int) -> np.ndarray:
        label_map = read_label_map(labels / sequence.frame_paths[index].name)
        return cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST)

    own = from_labels()
    sample = range(0, len(sequence), max(1, len(sequence) // 8))
    number = round(np.mean([len(keypoints.detect(sequence.frame(index), THESIS, own[index])) for index in sample]))
    methods: dict[str, tuple[OdometrySettings, Masks | None]] = {
        "baseline": (THESIS, None),
        "masked": (THESIS, own),
        "filter": (replace(THESIS, mask_mode="filter"), own),
        "nearest": (THESIS, MadeMasks(lambda index: masks.dilate(
            cv2.Canny(enlarged(index), *MaskSettings().canny), dilation_width))),
        "symmetric": (THESIS, from_labels(MaskSettings(symmetric=True))),
        "corrected": (THESIS, from_labels(CORRECTED)),
        "no-vegetation": (THESIS, MadeMasks(lambda index: without_classes(VEGETATION, enlarged(index)))),
        "strongest": (replace(THESIS, max_keypoints=max(1, number)), None),
        "random": (THESIS, MadeMasks(partial(random_keypoints, sequence, number))),
        "dropout": (THESIS, MadeMasks(partial(random_keypoints, sequence, 0.9))),
        **{f"strongest-{few}": (replace(THESIS, max_keypoints=few), None) for few in FEW_KEYPOINTS},
        "orb": (replace(THESIS, detector="orb"), None),
    }
    runs: Runs = {}
    for method, (settings, its_masks) in methods.items():
        for estimator in ESTIMATORS if method in ("baseline", "masked") else ("thesis", "refined"):
            of_null = method == "baseline" and estimator == "thesis"
            for repetition in range(max(repetitions, baseline_repetitions) if of_null else repetitions):
                seeded = replace(settings, estimator=estimator, shuffle_seed=repetition or None)
                runs[method, estimator, repetition] = seeded, its_masks
    return runs


# What the thesis's procedure reports of masks that do nothing (Section 4.2, Tables 4.2 and 4.3)

SEQUENCES, WIDTHS = 11, 15  # of the thesis
STUDIES = 4000  # that are simulated


def null_distribution(runs: pd.DataFrame, reported: pd.Series, widths: int = WIDTHS) -> pd.DataFrame:
    """What the thesis's procedure reports where masks do nothing: rows mean, median and sum of the changes (%).

    The thesis runs all keypoints once and masks of 15 widths once each, takes the best width of each sequence and
    averages Equation 4.1. If masks did nothing, these 16 runs would be one run with differently shuffled points. So
    16 errors are drawn for each sequence from the measured ones, and the procedure is applied, STUDIES times.

    runs: with all keypoints under one estimator, several repetitions of each sequence, columns sequence and rmse.
    reported: changes (%) of a study by sequence. Columns expected (mean of the studies), low, high (their middle LEVEL
    percent), and share_as_low (percent of the studies that report as low a number or a lower one).
    Errors are drawn with replacement, so the best of 15 is never better than the best error that was measured.
    """
    errors = np.random.default_rng(0).choice(deviations(runs), (STUDIES, SEQUENCES, widths + 1))
    changes = metrics.percent_change(np.exp(errors[..., 1:].min(axis=-1)), np.exp(errors[..., 0]))
    tail = (100 - LEVEL) / 2
    rows = {}
    for name, summarize in (("mean", np.mean), ("median", np.median), ("sum", np.sum)):
        values = summarize(changes, axis=1)
        rows[name] = {"expected": values.mean(), "low": np.percentile(values, tail),
                      "high": np.percentile(values, 100 - tail),
                      "share_as_low": 100 * (values <= summarize(reported.to_numpy())).mean()}
    return pd.DataFrame(rows).T


def deviations(runs: pd.DataFrame) -> np.ndarray:
    """Natural logarithms of errors less their mean over a sequence's repetitions, of all sequences together.

    They are widened by sqrt(n / (n - 1)), since the mean was taken from the same n errors. Columns sequence, rmse.
    """
    logarithms = np.log(runs["rmse"])
    of_sequence = logarithms.groupby(runs["sequence"])
    count = of_sequence.transform("size")
    widened = (logarithms - of_sequence.transform("mean")) * np.sqrt(count / (count - 1))
    return widened[count > 1].to_numpy()


# Where keypoints lie, and what becomes of boundaries

FIELDS = (16, 5)  # of a frame, across and down
NEAR = 2  # pixels: a boundary this near to an edge has been found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def tracks(sequence: Sequence, chosen: dict[str, Masks | None], pairs: int) -> pd.DataFrame:
    """How well keypoints can be tracked and how they are spread: one row a kind of mask and pair of frames.

    chosen: {name: masks, None for all keypoints}. pairs: frames, spread evenly, that are tracked to the next one.
    Columns: sequence, frame, method (the name), keypoints; residual, the median distance (pixels) of tracked points
    from the epipolar lines of the true motion; outliers, the share (percent) of points beyond PySLAM's threshold;
    fields, the share (percent) of the frame's 16 x 5 fields that hold a keypoint.
    """
    rows = []
    focal = sequence.intrinsics[0, 0]
    for index in np.unique(np.linspace(0, len(sequence) - 2, pairs).round().astype(int)):
        before, after = sequence.frame(index), sequence.frame(index + 1)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        if np.linalg.norm(motion[:3, 3]) < metrics.MIN_DIRECTED_STEP:
            continue
        for name, its_masks in chosen.items():
            points = keypoints.detect(before, THESIS, None if its_masks is None else its_masks[int(index)])
            if len(points) < 10:
                continue
            moved, tracked = keypoints.track(before, after, points)
            distances = _epipolar_distances(points[tracked], moved[tracked], motion, sequence.intrinsics)
            fields = (points // [sequence.size[1] / FIELDS[0], sequence.size[0] / FIELDS[1]]).astype(int)
            rows.append({"sequence": sequence.name, "frame": int(index), "method": name, "keypoints": len(points),
                         "residual": focal * float(np.median(distances)),
                         "outliers": 100 * (distances > THESIS.threshold).mean(),
                         "fields": 100 * len(np.unique(fields, axis=0)) / (FIELDS[0] * FIELDS[1])})
    return pd.DataFrame(rows)


def _epipolar_distances(previous: np.ndarray, current: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
                        ) -> np.ndarray:
    """Sampson distances of matched pixels (n, 2) under a 4x4 motion, in units of the focal length, (n,)."""
    seen, then = (np.column_stack([(points - intrinsics[:2, 2]) / intrinsics[0, 0], np.ones(len(points))])
                  for points in (previous, current))
    direction = motion[:3, 3] / np.linalg.norm(motion[:3, 3])
    essential = np.cross(np.eye(3), direction) @ motion[:3, :3]
    lines, back = then @ essential.T, seen @ essential
    return np.abs((seen * lines).sum(axis=1)) / np.sqrt((lines[:, :2] ** 2).sum(axis=1)
                                                        + (back[:, :2] ** 2).sum(axis=1))


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """What Canny on enlarged ids does to the boundaries of one label map (audit rows 10 and 11), in percent.

    lost: boundary pixels of the map enlarged by nearest neighbours with no edge within NEAR pixels, of all and of
    PAIRS of classes ("road/sidewalk"; NaN where the map has fewer than 20). invented: pixels whose bilinear id is
    neither that of the nearest neighbour nor of a class that lies within NEAR pixels.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    bilinear = cv2.resize(label_map, size[::-1])
    exact = masks.edges(label_map, size, MaskSettings("exact")) > 0
    missed = masks.dilate(masks.edges(label_map, size), 2 * NEAR + 1) == 0
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    there = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        there |= (bilinear == number) & (cv2.dilate((nearest == number).astype(np.uint8), around) > 0)
    shares = {"lost": 100 * missed[exact].mean() if exact.any() else np.nan, "invented": 100 * float((~there).mean())}
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    neighbour = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = [ID[name] for name in pair]
        of_pair = exact & np.isin(nearest, ids) & np.isin(neighbour, ids)
        shares["/".join(pair)] = 100 * missed[of_pair].mean() if of_pair.sum() >= 20 else np.nan
    return shares
