"""Real steps, recorded in numbers (tests/reference), and whole paths where the frames are at hand.

Every clone compares OpenCV, the exact search and both estimators with what PySLAM's calls gave.
"""

from functools import partial

import numpy as np
import pandas as pd
import pytest

import opencv_exact
import thesis_repro
from reference_steps import ESTIMATORS, FOLDER, STEPS, digest
from thesis_repro.data.kitti import Sequence
from thesis_repro.mask_files import MaskFolder
from thesis_repro.odometry import OPENCV, THESIS, Matches
from thesis_repro.odometry.odometry import PROBABILITY, VoteOfAll, normalise
from thesis_repro.odometry.refined import RefinedEstimator

CALLS = {
    "opencv": OPENCV,
    "exact": OPENCV._replace(
        find_essential_matrix=partial(opencv_exact.find_essential_matrix, probability=PROBABILITY),
        recover_pose=opencv_exact.recover_pose,
    ),
}
PATHS = pd.read_csv(FOLDER / "poses.csv", dtype=str)
LONG = 150  # frames; such paths take half a minute each


def recorded(run):
    """The steps of a file, one dict each, with normalised points."""
    with np.load(FOLDER / f"{run}.npz") as file:
        columns = dict(file)
    camera = columns.pop("camera")
    last_points = np.cumsum(columns["matches"])[:-1]
    last_rows = 3 * np.cumsum(columns["solutions"])[:-1]
    columns["matrices"] = np.split(columns["matrices"], last_rows)
    columns["inliers"] = np.split(columns["inliers"], last_points)
    for name in ("current", "previous"):
        columns[name] = np.split(normalise(columns[name], camera), last_points)
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values())]


def turns(rotations):
    """Angles of rotations, degrees."""
    cosines = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


@pytest.mark.parametrize("run", sorted(path.stem for path in FOLDER.glob("*.npz")))
@pytest.mark.parametrize("calls", CALLS.values(), ids=CALLS)
def test_real_steps_have_the_recorded_bits(run, calls):
    for step in recorded(run):
        points = step["current"], step["previous"]
        matrix, inliers = calls.find_essential_matrix(*points, THESIS.threshold)
        np.testing.assert_array_equal(matrix, step["matrices"])
        np.testing.assert_array_equal(inliers.ravel() > 0, step["inliers"])
        if step["solutions"] == 1:
            votes, rotation, translation = calls.recover_pose(matrix, *points)
            assert votes == step["votes"]
            np.testing.assert_array_equal(rotation, step["rotations"])
            np.testing.assert_array_equal(translation, step["translations"])


@pytest.mark.parametrize("run", STEPS)
def test_estimators_give_the_recorded_motions(run):
    vote, refined = VoteOfAll(), RefinedEstimator()
    for step in recorded(run):
        points = step["current"], step["previous"]
        matches = Matches(*points, THESIS.threshold, step["inliers"])
        arguments = step["matrices"], matches, step["scales"], step["updated"]
        motion = vote.motion(*arguments)
        assert motion.pose_inliers == step["votes"]
        np.testing.assert_array_equal(motion.rotation, step["rotations"])
        np.testing.assert_array_equal(motion.translation, step["translations"])
        motion = refined.motion(*arguments)
        assert motion.flag == step["flags"]
        # LAPACK's last digits differ between processors
        np.testing.assert_allclose(motion.rotation, step["refined_rotations"], 0, 1e-12)
        np.testing.assert_allclose(motion.translation, step["refined_translations"], 0, 1e-12)


def test_the_hard_cases_are_among_the_steps():
    files = {path.stem: dict(np.load(path)) for path in FOLDER.glob("*.npz")}
    motorway, town = files["01"], files["07_masked"]
    np.testing.assert_array_equal(motorway["translations"][:, 2] < -0.9, [False, True, True, True])
    assert motorway["refined_translations"][:, 2].min() > 0.9
    assert np.flatnonzero(turns(town["rotations"]) > 179) == [3]
    assert turns(town["refined_rotations"]).max() < 1
    assert (files["01_masked"]["flags"] == "ambiguous motion").sum() > 4
    assert set(files["few_points"]["matches"]) == {5, 6, 7, 8}
    assert set(files["few_points"]["solutions"]) > {1, 2, 4}
    assert files["no_parallax"]["votes"].tolist() == [0, 0]


@pytest.mark.real
@pytest.mark.parametrize("run", ["00", "00_masked", "06"])
def test_the_recorded_motions_are_pyslams(reference, run):
    path = pd.read_csv(reference / f"{run}.csv", index_col="frame")
    for step in recorded(run):
        expected = path.loc[step["frames"]]
        motion = [*step["rotations"].ravel(), *step["translations"]]
        np.testing.assert_array_equal(expected.filter(like="rel_"), motion)
        counts = step["matches"], step["inliers"].sum(), step["votes"]
        names = ["n_tracked", "n_inliers_E", "n_inliers_recoverPose"]
        np.testing.assert_array_equal(expected[names], counts)


def path_cases():
    """The recorded paths that need no masks but PySLAM's; long ones are torture."""
    cases = []
    for path in PATHS.itertuples():
        marks = [pytest.mark.torture] if int(path.frames) >= LONG else []
        if path.run not in ("01_masked", "07_masked"):
            cases.append(pytest.param(path, marks=marks, id=f"{path.run}-{path.estimator}"))
    return cases


@pytest.mark.real
@pytest.mark.parametrize("path", path_cases())
def test_whole_paths_have_the_recorded_digests(kitti_real, reference, path):
    sequence, masks = Sequence(kitti_real, path.run[:2]), None
    if "masked" in path.run:
        masks = MaskFolder(reference / "masks_00", sequence)
    result = thesis_repro.run(sequence, ESTIMATORS[path.estimator], masks)
    assert len(result.poses) == int(path.frames)
    assert digest(result.poses) == path.sha256
