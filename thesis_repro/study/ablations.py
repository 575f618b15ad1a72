"""Ablations: the effect of each single setting of the odometry and of the masks (notebook 09).

Every run differs from a reference run in one setting. The tables have the columns that `compare`
needs.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import masks, odometry
from thesis_repro.data.cityscapes import ID, read_label_map
from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings, keypoints, metrics
from thesis_repro.odometry.passes import Masks
from thesis_repro.odometry.pose import normalise
from thesis_repro.running import results
from thesis_repro.running.files import progress, write_text
from thesis_repro.study import workers
from thesis_repro.study.compare import LEVEL
from thesis_repro.study.jobs import CONTROL_WIDTH
from thesis_repro.study.runner import measures

# by method, estimator, repetition
Runs = dict[tuple[str, str, int], tuple[OdometrySettings, Masks | None]]
ESTIMATORS = ("thesis", "inliers", "refined")
# the second is for all keypoints with the thesis's estimator
REPETITIONS, BASELINE_REPETITIONS = 3, 8
VEGETATION = (ID["vegetation"], ID["terrain"])
FEW_KEYPOINTS = (100, 200, 400)  # a twentieth, a tenth and a fifth of the thesis's 2000


@dataclass(frozen=True)
class FunctionMasks:
    """Masks made by a function of the frame number: masks[i] for frame i."""

    function: Callable[[int], np.ndarray]

    def __getitem__(self, index: int) -> np.ndarray:
        return self.function(index)


def random_keypoints(sequence: Sequence, amount: int | float, index: int) -> np.ndarray:
    """Return a mask that keeps randomly drawn keypoints of a frame, one pixel each: a number
    (int) or share (float).
    """
    points = keypoints.detect(sequence.frame(index), THESIS).astype(int)
    number = amount if isinstance(amount, int) else round(amount * len(points))
    columns, rows = np.random.default_rng((0, index)).permutation(points)[:number].T
    mask = np.zeros(sequence.size, np.uint8)
    mask[rows, columns] = 255
    return mask


# The runs


def measure(
    sequences: Iterable[Sequence],
    labels: Path,
    folder: Path,
    *,
    processes: int = 1,
    **options: Any,
) -> pd.DataFrame:
    """Run every ablation on every sequence; returns a table with one row a run.

    labels: a folder with one folder of label maps a sequence. folder: for the results; finished
    sequences in it are not run again. options: those of `runs_of`.

    Columns: sequence, method, estimator, repetition, those of `runner.measures`, and sim3 (RMSE in
    metres after an alignment with scale).
    """
    calls = [
        (sequence, labels / sequence.name, folder / sequence.name, options)
        for sequence in sequences
    ]
    with workers.open_pool(processes) as pool:
        tables = dict(
            progress(pool.run(_measure, calls), "ablations", total=len(calls), unit="sequence")
        )
    return pd.concat([tables[index] for index in range(len(calls))], ignore_index=True)


def _measure(
    sequence: Sequence, labels: Path, folder: Path, options: dict[str, Any]
) -> pd.DataFrame:
    results.stage(
        folder,
        options=options,
        code=results.code("thesis_repro.study.ablations"),
        **results.made_with("opencv", "numpy", "numba"),
        sequence=results.listing(sequence.files),
        labels=results.listing([labels / path.name for path in sequence.frame_paths]),
        model=results.made_from(labels),
    )
    path = folder / "runs.csv"
    if results.kept_table(path) is None:
        cv2.setNumThreads(1)  # the processes already use every core
        runs = runs_of(sequence, labels, **options)
        run_results = odometry.run_many(
            sequence, {" ".join(map(str, key)): run for key, run in runs.items()}
        )
        rows = [
            {"method": method, "estimator": estimator, "repetition": repetition}
            | measures(result.frames, sequence.poses)
            | {"sim3": metrics.ate(result.poses, sequence.poses, "sim3")["rmse"]}
            for (method, estimator, repetition), result in zip(
                runs, run_results.values(), strict=True
            )
        ]
        write_text(path, pd.DataFrame(rows).assign(sequence=sequence.name).to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def runs_of(
    sequence: Sequence,
    labels: Path,
    *,
    repetitions: int = REPETITIONS,
    baseline_repetitions: int = BASELINE_REPETITIONS,
    dilation_width: int = CONTROL_WIDTH,
) -> Runs:
    """Return the runs over one sequence: {(method, estimator, repetition): (settings, masks)}.

    labels: folder of the sequence's label maps. "baseline" (all keypoints) and "masked" use each of
    ESTIMATORS, other methods the thesis's and the refined one. A repetition other than 0 is the
    seed that shuffles the matched points. `null_distribution` needs the `baseline_repetitions` with
    all keypoints and the thesis's estimator.
    """
    label_masks = partial(masks.LabelMasks, labels, sequence, dilation_width)

    def enlarged(index: int) -> np.ndarray:
        label_map = read_label_map(labels / sequence.frame_paths[index].name)
        return cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST)

    thesis_masks = label_masks()
    sample = range(0, len(sequence), max(1, len(sequence) // 8))
    number = round(
        np.mean(
            [
                len(keypoints.detect(sequence.frame(index), THESIS, thesis_masks[index]))
                for index in sample
            ]
        )
    )
    methods: dict[str, tuple[OdometrySettings, Masks | None]] = {
        "baseline": (THESIS, None),
        "masked": (THESIS, thesis_masks),
        "filter": (replace(THESIS, mask_mode="filter"), thesis_masks),
        "nearest": (
            THESIS,
            FunctionMasks(
                lambda index: masks.dilate(
                    cv2.Canny(enlarged(index), *MaskSettings().canny), dilation_width
                )
            ),
        ),
        "symmetric": (THESIS, label_masks(MaskSettings(symmetric=True))),
        # Section 5.2.2: trees and bushes
        "no-vegetation": (
            THESIS,
            FunctionMasks(
                lambda index: np.where(
                    np.isin(enlarged(index), VEGETATION), np.uint8(0), np.uint8(255)
                )
            ),
        ),
        "strongest": (replace(THESIS, max_keypoints=max(1, number)), None),
        "random": (THESIS, FunctionMasks(partial(random_keypoints, sequence, number))),
        "dropout": (THESIS, FunctionMasks(partial(random_keypoints, sequence, 0.9))),
        **{f"strongest-{few}": (replace(THESIS, max_keypoints=few), None) for few in FEW_KEYPOINTS},
        "orb": (replace(THESIS, detector="orb"), None),
    }
    runs: Runs = {}
    for method, (settings, method_masks) in methods.items():
        for estimator in ESTIMATORS if method in ("baseline", "masked") else ("thesis", "refined"):
            is_null = method == "baseline" and estimator == "thesis"
            for repetition in range(
                max(repetitions, baseline_repetitions) if is_null else repetitions
            ):
                seeded = replace(settings, estimator=estimator, shuffle_seed=repetition or None)
                runs[method, estimator, repetition] = seeded, method_masks
    return runs


# Results of the thesis's procedure if masks did nothing (Section 4.2, Tables 4.2 and 4.3)

SEQUENCES, WIDTHS = 11, 15  # of the thesis
STUDIES = 4000  # simulated ones


def null_distribution(
    runs: pd.DataFrame, reported: pd.Series, widths: int = WIDTHS
) -> pd.DataFrame:
    """Simulate what the thesis's procedure reports if masks do nothing; rows mean, median and sum
    of the changes (%).

    The thesis runs all keypoints once and masks of 15 widths once each, takes the best width of
    each sequence and averages Equation 4.1. If masks did nothing, these 16 runs would differ only
    in the order of the matched points. So the procedure is applied STUDIES times to 16 errors for
    each sequence, drawn with replacement from measured errors.

    runs: all keypoints under one estimator, several repetitions of each sequence, columns sequence
    and rmse.
    reported: the changes (%) that a study reports, by sequence. Columns: expected (mean of the
    simulated studies), low, high (their middle LEVEL percent), share_as_low (percent of them with
    the reported number or a lower one). The best of 15 drawn errors is never better than the best
    measured error.
    """
    errors = np.random.default_rng(0).choice(deviations(runs), (STUDIES, SEQUENCES, widths + 1))
    changes = metrics.percent_change(np.exp(errors[..., 1:].min(axis=-1)), np.exp(errors[..., 0]))
    tail = (100 - LEVEL) / 2
    rows = {}
    for name, summarize in (("mean", np.mean), ("median", np.median), ("sum", np.sum)):
        values = summarize(changes, axis=1)
        rows[name] = {
            "expected": values.mean(),
            "low": np.percentile(values, tail),
            "high": np.percentile(values, 100 - tail),
            "share_as_low": 100 * (values <= summarize(reported.to_numpy())).mean(),
        }
    return pd.DataFrame(rows).T


def deviations(runs: pd.DataFrame) -> np.ndarray:
    """Return the logarithms of all errors minus the mean logarithm of their sequence.

    They are scaled by sqrt(n / (n - 1)), since the mean comes from the same n repetitions. runs:
    sequence, rmse.
    """
    logarithms = np.log(runs["rmse"])
    by_sequence = logarithms.groupby(runs["sequence"])
    count = by_sequence.transform("size")
    widened = (logarithms - by_sequence.transform("mean")) * np.sqrt(count / (count - 1))
    return widened[count > 1].to_numpy()


# Keypoints and boundaries one by one

FIELDS = (16, 5)  # of a frame, across and down
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def tracks(sequence: Sequence, masks_by_name: dict[str, Masks | None], pairs: int) -> pd.DataFrame:
    """Measure how well keypoints can be tracked and how they are spread: one row for each mask and
    pair of frames.

    masks_by_name: None for all keypoints. pairs: number of evenly spread frames that are tracked to
    the next frame. Columns: sequence, frame, method (the name), keypoints; residual, the median
    distance (pixels) of tracked points from the epipolar lines of the true motion; outliers, the
    percentage of points beyond PySLAM's threshold; fields, the percentage of the frame's 16 x 5
    fields with a keypoint.
    """
    rows = []
    for index in np.unique(np.linspace(0, len(sequence) - 2, pairs).round().astype(int)):
        before, after = sequence.frame(index), sequence.frame(index + 1)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        if np.linalg.norm(motion[:3, 3]) < metrics.MIN_DIRECTED_STEP:
            continue
        for name, frame_masks in masks_by_name.items():
            points = keypoints.detect(
                before, THESIS, None if frame_masks is None else frame_masks[int(index)]
            )
            if len(points) < 10:
                continue
            moved, tracked = keypoints.track(before, after, points)
            distances = sampson_distances(
                points[tracked], moved[tracked], motion, sequence.intrinsics
            )
            fields = (
                points // [sequence.size[1] / FIELDS[0], sequence.size[0] / FIELDS[1]]
            ).astype(int)
            rows.append(
                {
                    "sequence": sequence.name,
                    "frame": int(index),
                    "method": name,
                    "keypoints": len(points),
                    "residual": sequence.intrinsics[0, 0] * float(np.median(distances)),
                    "outliers": 100 * (distances > THESIS.threshold).mean(),
                    "fields": 100 * len(np.unique(fields, axis=0)) / (FIELDS[0] * FIELDS[1]),
                }
            )
    return pd.DataFrame(rows)


def sampson_distances(
    previous: np.ndarray, current: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Return the Sampson distances (n,) of matched pixels (n, 2) under a 4x4 motion, in units
    of the focal length.
    """
    essential = np.cross(np.eye(3), motion[:3, 3]) @ motion[:3, :3]
    matches = zip(
        *(
            np.column_stack([normalise(points, intrinsics), np.ones(len(points))])
            for points in (current, previous)
        ),
        strict=True,
    )
    return np.sqrt([cv2.sampsonDistance(*match, essential) for match in matches])


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Measure what Canny on enlarged ids does to the boundaries of a label map, in percent (audit
    rows 10 and 11).

    lost: boundary pixels of the map, enlarged by nearest neighbour, without an edge within NEAR
    pixels. The same for each of PAIRS of classes ("road/sidewalk"), NaN for fewer than 20 boundary
    pixels. invented: pixels of the bilinear enlargement whose id no pixel within NEAR pixels has.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    bilinear = cv2.resize(label_map, size[::-1])
    exact = masks.edges(label_map, size, MaskSettings("exact")) > 0
    missed = masks.dilate(masks.edges(label_map, size), 2 * NEAR + 1) == 0
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    real = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        real |= (bilinear == number) & (
            cv2.dilate((nearest == number).astype(np.uint8), around) > 0
        )
    shares = {
        "lost": 100 * missed[exact].mean() if exact.any() else np.nan,
        "invented": 100 * float((~real).mean()),
    }
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    neighbour = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = [ID[name] for name in pair]
        pair_boundary = exact & np.isin(nearest, ids) & np.isin(neighbour, ids)
        shares["/".join(pair)] = (
            100 * missed[pair_boundary].mean() if pair_boundary.sum() >= 20 else np.nan
        )
    return shares
