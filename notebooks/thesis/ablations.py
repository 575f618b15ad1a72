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

from thesis_repro import mask_files, masks, odometry
from thesis_repro.data.cityscapes import ID, read_label_map
from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings, estimators, metrics
from thesis_repro.odometry.odometry import detect, normalise, track
from thesis_repro.odometry.runs import Masks
from thesis_repro.running import results
from thesis_repro.running.files import progress, write_text
from thesis_repro.study import workers
from thesis_repro.study.jobs import CONTROL_WIDTH
from thesis_repro.study.runner import CODE, measures

Run = tuple[OdometrySettings, Masks | None]
Runs = dict[tuple[str, str, int], Run]  # by method, estimator, repetition
ESTIMATORS = tuple(estimators.ESTIMATORS)
VEGETATION = (ID["vegetation"], ID["terrain"])
FEW_KEYPOINTS = (100, 200, 400)  # a twentieth, a tenth and a fifth of the thesis's 2000


@dataclass(frozen=True)
class FunctionMasks:
    """Masks made by a function of the frame number: masks[i] for frame i."""

    function: Callable[[int], np.ndarray]

    def __getitem__(self, index: int) -> np.ndarray:
        return self.function(index)


def random_keypoints(sequence: Sequence, amount: int | float, index: int) -> np.ndarray:
    """Return a mask that keeps randomly drawn keypoints of a frame, one pixel each.

    amount: their number (int), or their share of all keypoints (float).
    """
    points = detect(sequence.frame(index), THESIS).astype(int)
    number = amount
    if isinstance(amount, float):
        number = round(amount * len(points))
    shuffled = np.random.default_rng((0, index)).permutation(points)
    columns, rows = shuffled[:number].T
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
        measured = pool.run(_measure, calls)
        tables = list(progress(measured, "ablations", total=len(calls), unit="sequence"))
    return pd.concat(tables, ignore_index=True)


def _measure(
    sequence: Sequence, labels: Path, folder: Path, options: dict[str, Any]
) -> pd.DataFrame:
    results.stage(
        folder,
        options=options,
        code=results.digest_of_code(*CODE),
        ablations=results.digest_of_file(__file__),
        **results.made_with("opencv", "numpy", "numba"),
        sequence=results.digest_of_files(sequence.files),
        labels=results.digest_of_files([labels / path.name for path in sequence.frame_paths]),
        model=results.made_from(labels),
    )
    path = folder / "runs.csv"
    if not path.is_file():
        cv2.setNumThreads(1)  # the processes already use every core
        runs = runs_of(sequence, labels, **options)
        run_results = odometry.run_many(
            sequence, {" ".join(map(str, key)): run for key, run in runs.items()}
        )
        rows = []
        for key, result in zip(runs, run_results.values(), strict=True):
            method, estimator, repetition = key
            row = {"method": method, "estimator": estimator, "repetition": repetition}
            row |= measures(result.frames, sequence.poses)
            row["sim3"] = metrics.ate(result.poses, sequence.poses, "sim3")
            rows.append(row)
        table = pd.DataFrame(rows).assign(sequence=sequence.name)
        write_text(path, table.to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def runs_of(
    sequence: Sequence,
    labels: Path,
    *,
    repetitions: int = 1,
    dilation_width: int = CONTROL_WIDTH,
) -> Runs:
    """Return the runs over one sequence: {(method, estimator, repetition): (settings, masks)}.

    labels: folder of the sequence's label maps. "baseline" (all keypoints) and "masked" use each of
    ESTIMATORS, other methods the thesis's and the refined one. A repetition other than 0 is the
    seed that shuffles the matched points.
    """
    runs: Runs = {}
    for method, (settings, method_masks) in _methods(sequence, labels, dilation_width).items():
        estimators: tuple[str, ...] = ("thesis", "refined")
        if method in ("baseline", "masked"):
            estimators = ESTIMATORS
        for estimator in estimators:
            for repetition in range(repetitions):
                seeded = replace(settings, estimator=estimator, shuffle_seed=repetition or None)
                runs[method, estimator, repetition] = seeded, method_masks
    return runs


def _methods(sequence: Sequence, labels: Path, dilation_width: int) -> dict[str, Run]:
    """Return the ablations over one sequence: {method: (settings, masks)}."""

    def enlarged(index: int) -> np.ndarray:
        label_map = read_label_map(labels / sequence.frame_paths[index].name)
        return cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST)

    def nearest(index: int) -> np.ndarray:
        edges = cv2.Canny(enlarged(index), *MaskSettings().canny)
        return masks.dilate(edges, dilation_width)

    def without_vegetation(index: int) -> np.ndarray:
        is_vegetation = np.isin(enlarged(index), VEGETATION)
        return np.where(is_vegetation, np.uint8(0), np.uint8(255))

    thesis_masks = mask_files.LabelMasks(labels, sequence, dilation_width)
    symmetric = mask_files.LabelMasks(
        labels, sequence, dilation_width, MaskSettings(symmetric=True)
    )
    number = _mean_number(sequence, thesis_masks)
    methods: dict[str, Run] = {
        "baseline": (THESIS, None),
        "masked": (THESIS, thesis_masks),
        "filter": (replace(THESIS, mask_mode="filter"), thesis_masks),
        "nearest": (THESIS, FunctionMasks(nearest)),
        "symmetric": (THESIS, symmetric),
        # Section 5.2.2: trees and bushes
        "no-vegetation": (THESIS, FunctionMasks(without_vegetation)),
        "strongest": (replace(THESIS, max_keypoints=max(1, number)), None),
        "random": (THESIS, FunctionMasks(partial(random_keypoints, sequence, number))),
        "dropout": (THESIS, FunctionMasks(partial(random_keypoints, sequence, 0.9))),
    }
    for few in FEW_KEYPOINTS:
        methods[f"strongest-{few}"] = replace(THESIS, max_keypoints=few), None
    methods["orb"] = replace(THESIS, detector="orb"), None
    return methods


def _mean_number(sequence: Sequence, frame_masks: Masks) -> int:
    """Return the mean number of keypoints that masks leave, from about eight frames."""
    numbers = []
    for index in range(0, len(sequence), max(1, len(sequence) // 8)):
        points = detect(sequence.frame(index), THESIS, frame_masks[index])
        numbers.append(len(points))
    return round(np.mean(numbers))


# Keypoints and boundaries one by one

FIELDS = (16, 5)  # of a frame, across and down
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def tracks(sequence: Sequence, masks_by_name: dict[str, Masks | None], pairs: int) -> pd.DataFrame:
    """Measure how well keypoints can be tracked and how they are spread.

    masks_by_name: None for all keypoints. pairs: number of evenly spread frames that are tracked to
    the next frame. Returns one row for each mask and pair of frames. Columns: sequence, frame,
    method (the name), keypoints; residual, the median distance (pixels) of tracked points from the
    epipolar lines of the true motion; outliers, the percentage of points beyond PySLAM's threshold;
    fields, the percentage of the frame's 16 x 5 fields with a keypoint.
    """
    rows = []
    height, width = sequence.size
    field_size = np.array([width / FIELDS[0], height / FIELDS[1]])
    indices = np.linspace(0, len(sequence) - 2, pairs).round().astype(int)
    for index in np.unique(indices).tolist():
        before, after = sequence.frame(index), sequence.frame(index + 1)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        if np.linalg.norm(motion[:3, 3]) < metrics.MIN_DIRECTED_STEP:
            continue
        for name, frame_masks in masks_by_name.items():
            mask = None
            if frame_masks is not None:
                mask = frame_masks[index]
            points = detect(before, THESIS, mask)
            if len(points) < 10:
                continue
            moved, tracked = track(before, after, points)
            distances = sampson_distances(
                points[tracked], moved[tracked], motion, sequence.intrinsics
            )
            fields = np.unique((points // field_size).astype(int), axis=0)
            row = {
                "sequence": sequence.name,
                "frame": index,
                "method": name,
                "keypoints": len(points),
                "residual": sequence.intrinsics[0, 0] * float(np.median(distances)),
                "outliers": 100 * (distances > THESIS.threshold).mean(),
                "fields": 100 * len(fields) / (FIELDS[0] * FIELDS[1]),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def sampson_distances(
    previous: np.ndarray, current: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Return the Sampson distances (n,) of matched pixels (n, 2) under a 4x4 motion.

    They are in units of the focal length. intrinsics: the 3x3 camera matrix.
    """
    essential = np.cross(np.eye(3), motion[:3, 3]) @ motion[:3, :3]
    ones = np.ones(len(previous))
    previous_rays = np.column_stack([normalise(previous, intrinsics), ones])
    current_rays = np.column_stack([normalise(current, intrinsics), ones])
    squares = [
        cv2.sampsonDistance(current_ray, previous_ray, essential)
        for current_ray, previous_ray in zip(current_rays, previous_rays, strict=True)
    ]
    return np.sqrt(squares)


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Measure what Canny on enlarged ids does to the boundaries of a label map, in percent.

    (Audit rows 10 and 11.) size: (height, width) of the enlargement.
    lost: boundary pixels of the map, enlarged by nearest neighbour, without an edge within NEAR
    pixels. The same for each of PAIRS of classes ("road/sidewalk"), NaN for fewer than 20 boundary
    pixels. invented: pixels of the bilinear enlargement whose id no pixel within NEAR pixels has.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    exact = masks.edges(label_map, size, MaskSettings("exact")) > 0
    missed = masks.dilate(masks.edges(label_map, size), 2 * NEAR + 1) == 0
    shares = {
        "lost": _percent_missed(missed, exact, least=1),
        "invented": _percent_invented(label_map, nearest),
    }
    # across a boundary: the pixel to the right or, if that has the same id, the one below
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    neighbour = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = [ID[name] for name in pair]
        pair_boundary = exact & np.isin(nearest, ids) & np.isin(neighbour, ids)
        shares["/".join(pair)] = _percent_missed(missed, pair_boundary, least=20)
    return shares


def _percent_missed(missed: np.ndarray, boundary: np.ndarray, least: int) -> float:
    """Return the percentage of a boundary's pixels that are missed; NaN for fewer than `least`."""
    if boundary.sum() < least:
        return np.nan
    return 100 * missed[boundary].mean()


def _percent_invented(label_map: np.ndarray, nearest: np.ndarray) -> float:
    """Return the percentage of pixels with an invented id, see `boundaries`.

    nearest: the label map, enlarged by nearest neighbour.
    """
    height, width = nearest.shape
    bilinear = cv2.resize(label_map, (width, height))
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    is_real = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        has_number = (nearest == number).astype(np.uint8)
        is_near = cv2.dilate(has_number, around) > 0
        is_real |= (bilinear == number) & is_near
    return 100 * float((~is_real).mean())
