"""Ablations: the effect of each single setting of the odometry and of the masks (notebook 09).

Every run differs from a reference run in one setting. The tables have the columns that
`comparisons` needs.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from keypoint_study.jobs import CONTROL_WIDTH, Job, Run
from keypoint_study.methods import Choice, changed
from keypoint_study.runner import run_all, run_poses
from thesis_repro import masks
from thesis_repro.data.cityscapes import ID, read_label_map, resize_bilinear
from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.masks.folders import LabelMasks
from thesis_repro.odometry import THESIS, keypoints, metrics
from thesis_repro.odometry.loop import detect, normalise, track
from thesis_repro.running import provenance

ESTIMATORS = ("thesis", "inliers", "refined")  # a new one is compared when it is named here
VEGETATION = (ID["vegetation"], ID["terrain"])
# pixels that are kept; the first two leave out distant points, the last near ones
PARALLAX = {"parallax-1": (1, np.inf), "parallax-3": (3, np.inf), "parallax-20": (0, 20)}
FEW_KEYPOINTS = (100, 200, 400)  # a twentieth, a tenth and a fifth of the thesis's 2000


@dataclass(frozen=True)
class FunctionMasks:
    """Masks made by a function of the frame number: masks[i] for frame i."""

    function: Callable[[int], np.ndarray]

    def __getitem__(self, index: int) -> np.ndarray:
        return self.function(index)


@lru_cache(maxsize=2)  # several masks of one frame use it
def all_keypoints(sequence: Sequence, index: int) -> np.ndarray:
    """Return the thesis's keypoints (n, 2) of a frame."""
    return detect(sequence.frame(index), THESIS)


def random_keypoints(sequence: Sequence, amount: int | float, index: int) -> np.ndarray:
    """Return a mask that keeps randomly drawn keypoints of a frame, one pixel each.

    amount: their number (int), or their share of all keypoints (float).
    """
    points = all_keypoints(sequence, index).astype(int)
    if isinstance(amount, float):
        amount = round(amount * len(points))
    shuffled = np.random.default_rng((0, index)).permutation(points)
    columns, rows = shuffled[:amount].T
    mask = np.zeros(sequence.size, np.uint8)
    mask[rows, columns] = 255
    return mask


@lru_cache(maxsize=2)  # several masks of one frame use it
def parallax(sequence: Sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints (n, 2) of a frame that are tracked into the next, and their parallax.

    Parallax (pixels): how far a point moves beyond what the true rotation explains. It is large for
    near points and small for distant ones. Uses the ground truth, which an odometry does not have.
    """
    points = all_keypoints(sequence, index)
    moved, tracked = track(sequence.frame(index), sequence.frame(index + 1), points)
    motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
    rays = np.column_stack([normalise(points, sequence.intrinsics), np.ones(len(points))])
    turned = rays @ motion[:3, :3] @ sequence.intrinsics.T  # of points at infinity
    distances = np.linalg.norm(moved - turned[:, :2] / turned[:, 2:], axis=1)
    return points[tracked], distances[tracked]


def with_parallax(sequence: Sequence, least: float, most: float, index: int) -> np.ndarray:
    """Return a mask that keeps the keypoints with a parallax in a range, one pixel each.

    (Section 5.2.2: keypoints that are far away, or close to the camera, are left out.)
    """
    mask = np.zeros(sequence.size, np.uint8)
    if index + 1 < len(sequence):  # those of the last frame are not used
        points, distances = parallax(sequence, index)
        columns, rows = points[(distances >= least) & (distances < most)].astype(int).T
        mask[rows, columns] = 255
    return mask


def as_many(sequence: Sequence, least: float, most: float, index: int) -> np.ndarray:
    """Return a mask that keeps as many keypoints as `with_parallax`, drawn at random."""
    number = int(np.count_nonzero(with_parallax(sequence, least, most, index)))
    return random_keypoints(sequence, number, index)


def half_in_turns(sequence: Sequence, into: bool, index: int) -> np.ndarray:
    """Return a mask that keeps one half of the frame in a turn, and elsewhere all of it.

    into: whether it is the half that the camera turns into (Section 5.2.2). Which steps turn is
    known from the ground truth (`metrics.TURN_RATE`).
    """
    mask = np.full(sequence.size, 255, np.uint8)
    following = sequence.poses[index : index + 2]
    motion = np.linalg.inv(following[0]) @ following[-1]
    if metrics.angles(motion) > metrics.TURN_RATE:
        middle = sequence.size[1] // 2
        turns_right = motion[0, 2] > 0  # the optical axis moves to the right
        mask[np.s_[:, :middle] if turns_right == into else np.s_[:, middle:]] = 0
    return mask


# The runs


def run_choices(
    choices: Callable[[Sequence], Mapping[str, Choice]],
    sequences: Iterable[Sequence],
    labels: Path,
    folder: Path,
    code: str,
    estimators: Iterable[str],
    repetitions: int = 1,
    processes: int = 1,
) -> pd.DataFrame:
    """Run choices of keypoints on sequences by `runner.run_all`; returns a table, one row a run.

    choices: a function of a sequence that returns {method: (settings, masks)}. labels: a folder
    with one folder of label maps a sequence. folder: for the results; those made from the same
    label maps and by the same code, the file of `choices`, are not made again. A repetition other
    than 0 is the seed that shuffles the matched points. The estimator "inliers" is run for all
    keypoints and masks alone.
    """
    runs: dict[Job, Run | str] = {}
    inputs = {}
    for sequence in sequences:
        maps = [labels / sequence.name / path.name for path in sequence.frame_paths]
        inputs[sequence.name] = {
            "choices": provenance.digest_of_file(code),
            "labels": provenance.digest_of_files(maps),
        }
        for (method, (settings, given)), estimator, repetition in product(
            choices(sequence).items(), estimators, range(repetitions)
        ):
            if estimator != "inliers" or method in ("baseline", "masked"):
                job = Job(sequence.name, method, estimator=estimator, repetition=repetition)
                runs[job] = Run(sequence, changed(settings, job.changes()), given)
    return run_all(runs, folder, inputs=inputs, processes=processes).table


def run_ablations(
    sequences: list[Sequence], labels: Path, folder: Path, repetitions: int = 1, processes: int = 1
) -> pd.DataFrame:
    """Run every ablation on every sequence with ESTIMATORS, see `run_choices`.

    Columns: sequence, method, estimator, repetition, those of `runner.run_all`, and sim3 (RMSE in
    metres after an alignment with scale).
    """
    table = run_choices(
        lambda sequence: choices(sequence, labels),
        sequences,
        labels,
        folder,
        __file__,
        ESTIMATORS,
        repetitions,
        processes,
    )
    poses = run_poses(table, folder)
    true = {sequence.name: sequence.poses for sequence in sequences}
    pairs = zip(table["sequence"], table["run"])
    table["sim3"] = [metrics.ate(poses[name, run], true[name], "sim3") for name, run in pairs]
    return table


def choices(sequence: Sequence, labels: Path) -> dict[str, Choice]:
    """Return the ablations over one sequence: {method: (settings, masks)}.

    labels: a folder with one folder of label maps a sequence.
    """

    def enlarged(index: int) -> np.ndarray:
        label_map = read_label_map(thesis_masks.paths[index])
        return cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST)

    def nearest(index: int) -> np.ndarray:
        return masks.dilate(cv2.Canny(enlarged(index), *masks.CANNY), CONTROL_WIDTH)

    def without_vegetation(index: int) -> np.ndarray:
        return np.where(np.isin(enlarged(index), VEGETATION), np.uint8(0), np.uint8(255))

    def random(amount: int | float) -> Choice:
        return THESIS, FunctionMasks(partial(random_keypoints, sequence, amount))

    thesis_masks = LabelMasks(labels, sequence, CONTROL_WIDTH)
    symmetric = LabelMasks(labels, sequence, CONTROL_WIDTH, MaskSettings(symmetric=True))
    some_frames = range(0, len(sequence), max(1, len(sequence) // 8))
    numbers = [len(detect(sequence.frame(i), THESIS, thesis_masks[i])) for i in some_frames]
    number = round(np.mean(numbers))  # that masks leave
    methods: dict[str, Choice] = {
        "baseline": (THESIS, None),
        "masked": (THESIS, thesis_masks),
        "filter": (replace(THESIS, detector=keypoints.filtered), thesis_masks),
        "nearest": (THESIS, FunctionMasks(nearest)),
        "symmetric": (THESIS, symmetric),
        # Section 5.2.2: trees and bushes
        "no-vegetation": (THESIS, FunctionMasks(without_vegetation)),
        "strongest": (replace(THESIS, max_keypoints=max(1, number)), None),
        "random": random(number),
        "dropout": random(0.9),
    }
    for few in FEW_KEYPOINTS:
        methods[f"strongest-{few}"] = replace(THESIS, max_keypoints=few), None
    for name, span in PARALLAX.items():
        for prefix, function in {"": with_parallax, "as many as ": as_many}.items():
            chosen = FunctionMasks(partial(function, sequence, *span))
            methods[prefix + name] = THESIS, chosen
    for name, into in {"turned-into": True, "turned-from": False}.items():
        methods[name] = THESIS, FunctionMasks(partial(half_in_turns, sequence, into))
    return methods | {"orb": (replace(THESIS, detector=keypoints.orb), None)}


# Keypoints and boundaries one by one

FIELDS = (16, 5)  # of a frame, across and down
EXACT = MaskSettings("exact")
THIN = MaskSettings("exact", classes=("pole", "traffic sign"))
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def tracks(sequence: Sequence, masks_by_name: dict[str, Any], pairs: int) -> pd.DataFrame:
    """Measure how well keypoints can be tracked and how they are spread.

    masks_by_name: a mask a frame, None for all keypoints. pairs: number of evenly spread frames
    that are tracked to the next frame. Returns one row for each mask and pair of frames. Columns:
    sequence, frame, method (the name), keypoints; residual, the median distance (pixels) of tracked
    points from the epipolar lines of the true motion; outliers, the percentage of points beyond
    PySLAM's threshold; fields, the percentage of the frame's 16 x 5 fields with a keypoint.
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
            points = detect(before, THESIS, frame_masks[index])
            if len(points) < 10:
                continue
            moved, tracked = track(before, after, points)
            matches = points[tracked], moved[tracked]
            distances = sampson_distances(*matches, motion, sequence.intrinsics)
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

    (Audit rows 10, 11, 71 and 72.) size: (height, width) of the enlargement.
    lost: boundary pixels of the map, enlarged by nearest neighbour, without an edge within NEAR
    pixels. The same for each of PAIRS of classes ("road/sidewalk"), NaN for fewer than 20 boundary
    pixels. invented: pixels of the bilinear enlargement whose id no pixel within NEAR pixels has.
    L2, Gaussian: edge pixels, of either kind, that change with the root of squares (Equation 3.11)
    and after a Gaussian.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    bilinear = resize_bilinear(label_map, size)
    exact = masks.edges(label_map, size, EXACT) > 0
    edges = masks.edges(label_map, size)
    missed = masks.dilate(edges, 2 * NEAR + 1) == 0
    shares = {
        "lost": _percent(missed, exact, least=1),
        "invented": _percent_invented(bilinear, nearest),
    }
    # across a boundary: the pixel to the right or, if that has the same id, the one below
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    neighbour = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = [ID[name] for name in pair]
        pair_boundary = exact & np.isin(nearest, ids) & np.isin(neighbour, ids)
        shares["/".join(pair)] = _percent(missed, pair_boundary, least=20)
    for name, other in (
        ("L2", cv2.Canny(bilinear, *masks.CANNY, L2gradient=True)),
        ("Gaussian", cv2.Canny(cv2.GaussianBlur(bilinear, (5, 5), 0), *masks.CANNY)),
    ):
        shares[name] = 100 * (edges != other).sum() / max(np.count_nonzero(edges | other), 1)
    return shares


def thin_boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Return the shares (%) of the boundaries of thin objects that are near an edge.

    (Audit row 87.) By the thresholds of Canny ("thin 5/15"). NaN without thin objects.
    """
    edges_by_name = {}
    for low, high in ((5, 15), (20, 60), (40, 120)):
        canny = MaskSettings(canny=(low, high))
        edges_by_name[f"thin {low}/{high}"] = masks.edges(label_map, size, canny)
    thin = masks.edges(label_map, size, THIN) > 0
    return {
        name: _percent(masks.dilate(edges, 2 * NEAR + 1) > 0, thin, least=1)
        for name, edges in edges_by_name.items()
    }


def _percent(marked: np.ndarray, boundary: np.ndarray, least: int) -> float:
    """Return the percentage of a boundary's pixels that are marked; NaN for fewer than `least`."""
    if boundary.sum() < least:
        return np.nan
    return 100 * marked[boundary].mean()


def _percent_invented(bilinear: np.ndarray, nearest: np.ndarray) -> float:
    """Return the percentage of pixels with an invented id, see `boundaries`."""
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    is_real = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        is_near = cv2.dilate((nearest == number).astype(np.uint8), around) > 0
        is_real |= (bilinear == number) & is_near
    return 100 * float((~is_real).mean())
