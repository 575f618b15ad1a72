"""The odometry against PySLAM's runs, its rules for bad frames, and its settings."""

import json
import pickle
from dataclasses import dataclass, replace
from fractions import Fraction

import cv2
import numpy as np
import pandas as pd
import pytest
from reference_steps import FOLDER, estimated, matched_points
from street import Street, Stripes

from thesis_repro import odometry
from thesis_repro.data.sequence import Sequence
from thesis_repro.data.trajectories import read_poses
from thesis_repro.errors import InputError
from thesis_repro.masks.folders import MaskFolder
from thesis_repro.odometry import (
    OPENCV,
    THESIS,
    Matches,
    Odometry,
    OdometrySettings,
    inputs,
    keypoints,
    metrics,
    sharing,
)
from thesis_repro.odometry.estimators import ESTIMATORS, refined
from thesis_repro.odometry.loop import VoteOfAll, detect, track
from thesis_repro.odometry.step import ROTATION_COLUMNS

SMALL = replace(THESIS, max_keypoints=500)  # quicker
COUNTS = {
    "points": "n_kps_to_lk",
    "detected": "n_detected",
    "tracked": "n_tracked",
    "inliers": "n_inliers_E",
    "pose_inliers": "n_inliers_recoverPose",
}
# {run: RMSE and MAE, metres}
PYSLAM = {
    "00": (1.431455, 0.509210),
    "00_masked": (1.457628, 0.549792),
    "01": (11.562321, 4.386078),  # from frame 17 on, the vote moves the camera backwards
    "03": (0.287625, 0.107206),
    "03_masked": (0.280460, 0.101638),
    "06": (0.357133, 0.146225),
}


def separately(sequence, runs):
    """What `run_many` gives, by a run each."""
    return {name: odometry.run(sequence, *arguments) for name, arguments in runs.items()}


@pytest.mark.real
@pytest.mark.parametrize(
    "make, runs",
    [
        (odometry.run_many, ["03", "03_masked"]),
        # a minute; in test_reference.py, the whole paths of 01 and 06 have the recorded bits
        pytest.param(separately, ["06"], marks=pytest.mark.torture),
        pytest.param(separately, ["01"], marks=pytest.mark.torture),
        pytest.param(odometry.run_many, ["00", "00_masked"], marks=pytest.mark.torture),
        pytest.param(separately, ["00", "00_masked"], marks=pytest.mark.torture),
    ],
)
def test_agrees_with_pyslam_on_every_frame(kitti_real, reference, make, runs):
    sequence = Sequence(kitti_real, runs[0])
    masks = MaskFolder(reference / f"masks_{runs[0]}", sequence) if len(runs) > 1 else None
    results = make(sequence, {run: (THESIS, masks if "_" in run else None) for run in runs})
    for run, result in results.items():
        expected, true = pd.read_csv(reference / f"{run}.csv"), sequence.poses
        assert len(result.frames) == len(expected) == len(true)
        assert result.flagged.empty or run == "01"
        for ours, theirs in COUNTS.items():
            counts = result.frames[ours].to_numpy(float, na_value=np.nan)
            np.testing.assert_array_equal(counts, expected[theirs])
        columns = ["x", "y", "z", *ROTATION_COLUMNS]
        np.testing.assert_allclose(result.frames[columns], expected[columns], rtol=0, atol=1e-9)
        steps, expected_steps = result.frames[1:], expected[1:]
        np.testing.assert_allclose(steps["scale"], expected_steps["gt_scale"], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(steps["updated"], expected_steps["pose_updated"] == 1)
        errors = metrics.rmse(result.poses, true), metrics.mae(result.poses, true)
        assert errors == pytest.approx(PYSLAM[run], abs=5e-7)


@pytest.fixture(scope="module")
def drive():
    return Street()


@pytest.mark.parametrize("masks", [[None] * 10, Stripes(40)], ids=["all", "masked"])
def test_agrees_with_the_same_calls_of_opencv(drive, masks):
    """Here every step detects anew, so that each can be made from two frames alone."""
    result, pose = odometry.run(drive, masks=masks), np.eye(4)
    for index in range(1, len(drive)):
        frames = drive.frame(index - 1), drive.frame(index)
        step = estimated(*matched_points(*frames, masks[index - 1]), drive.intrinsics)
        row = result.frames.loc[index]
        assert row["detected"] > 0 and row["tracked"] == step["matches"]
        assert (row["inliers"], row["pose_inliers"]) == (step["inliers"].sum(), step["votes"])
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = step["rotations"], row["scale"] * step["translations"]
        pose = pose @ motion
        np.testing.assert_allclose(result.poses[index], pose, rtol=0, atol=1e-12)
    assert metrics.rmse(result.poses, drive.poses) < 0.05


@pytest.mark.parametrize("mask", [None, "stripes", "nothing", "specks"])
def test_keypoints_have_opencvs_bits(drive, mask):
    frame = drive.frame(3)
    masks = {
        "stripes": Stripes(20)[0],
        "nothing": np.zeros_like(frame),
        "specks": (np.random.RandomState(0).rand(*frame.shape) < 0.02).astype(np.uint8),
    }
    # the second image has many corners of equal strength
    cases = [
        (image, replace(THESIS, min_distance=distance, max_keypoints=limit))
        for image in (frame, frame // 64 * 64, np.full_like(frame, 7))
        for distance in (0, 1, 2.4, 3, 7)
        for limit in (10, 2000, 0)
    ]
    shared = sharing.SharedCalls()
    for image, settings in [*cases, (frame, replace(THESIS, quality=0.05, block_size=9))]:
        arguments = image, settings, masks.get(mask)
        np.testing.assert_array_equal(shared.detect(*arguments), OPENCV.detect(*arguments))


def test_tracks_have_opencvs_bits(drive):
    frame = drive.frame(3)
    points = detect(frame)
    # at -40 a window leaves the frame
    for shift, window, levels in ((3, 21, 3), (12, 21, 3), (-40, 21, 3), (12, 11, 3), (12, 21, 1)):
        moved = np.roll(frame, shift, axis=1)
        settings = replace(THESIS, window=window, levels=levels)
        for ours, expected in zip(
            sharing.track(frame, moved, points, settings), track(frame, moved, points, settings)
        ):
            np.testing.assert_array_equal(ours, expected)


def test_keypoints_and_tracks_of_a_sharp_turn_have_the_bits_of_literal_calls():
    """Noise turns as the real camera did in the sharpest recorded step, 3 degrees."""
    with np.load(FOLDER / "05.npz") as step:
        camera, turn = step["camera"], step["true_motions"][-1][:3, :3]
    texture = np.random.RandomState(0).randint(0, 256, (24, 78)).astype(np.uint8)
    frame = cv2.resize(texture, (1241, 376))
    warp = camera @ turn.T @ np.linalg.inv(camera)
    turned = cv2.warpPerspective(frame, warp, (1241, 376))
    points = detect(frame)
    tracks = [track(frame, turned, points, replace(THESIS, levels=levels)) for levels in (3, 2, 4)]
    tracked, was_found = tracks[0]
    expected = matched_points(frame, turned)
    np.testing.assert_array_equal((points[was_found], tracked[was_found]), expected)
    assert all((each[0][was_found] != tracked[was_found]).any() for each in tracks[1:])


def test_a_mask_in_the_detector_fills_the_limit_and_a_filter_does_not(drive):
    inside, filtered = (
        find(drive.frame(0), SMALL, Stripes(40)[0]) for find in (detect, keypoints.filtered)
    )
    assert len(inside) == 500 and 100 < len(filtered) < 400


def nearest_neighbours(points):
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return np.sort(distances, axis=1)[:, 1]


def test_spread_keypoints_are_as_many_and_farther_apart(drive):
    frame = drive.frame(0)
    everything = detect(frame, replace(THESIS, max_keypoints=0))
    corners = detect(frame, replace(THESIS, max_keypoints=0, min_distance=0))
    spread = keypoints.spread(100)(frame)
    assert len(spread) == len(everything[:100]) == 100
    assert {*map(tuple, spread)} <= {*map(tuple, corners)}
    assert nearest_neighbours(spread).min() > 2 * nearest_neighbours(everything[:100]).min()
    # the strongest one is always taken, and as many as there are if those are fewer
    np.testing.assert_array_equal(spread[0], everything[0])
    all_spread = keypoints.spread(10**6)(frame)
    np.testing.assert_array_equal(all_spread, everything)


def test_a_filled_mask_leaves_no_field_empty(drive):
    frame, mask = drive.frame(0), np.zeros(drive.size, np.uint8)
    mask[:, :240] = 255
    plain = detect(frame, THESIS, mask)
    filled = keypoints.filled(3)(frame, THESIS, mask)
    np.testing.assert_array_equal(filled[: len(plain)], plain)
    everything = detect(frame, replace(THESIS, max_keypoints=0))
    for row, column in np.ndindex(5, 16):
        counts = [
            (points // (30, 32) == (column, row)).all(axis=1).sum()
            for points in (plain, filled, everything)
        ]
        assert counts[1] == max(counts[0], min(3, counts[2])), (row, column, counts)
    assert nearest_neighbours(filled).min() >= 3


SQUARES = {(67, 117): 130, (157, 57): 90, (257, 67): 60, (407, 107): 40}  # centre, contrast
FEW = 30  # keypoints; noise has more corners
ON_PURPOSE = {"filled": "mask", "orb": "order"}  # fills the frame; lists one scale after another


def found(detector, frame, mask=None):
    """At most FEW keypoints of a detector, or of one with a number."""
    settings = replace(THESIS, max_keypoints=FEW)
    made = detector(FEW) if isinstance(detector, type) else detector
    return inputs.keypoints(made(frame, settings, mask), frame, "detector")


@pytest.mark.parametrize("name", [*keypoints.DETECTORS, "shi-tomasi"])
def test_each_detector_finds_the_strongest_corners_within_limit_and_mask(drive, name):
    """Squares of 14 pixels in a wide frame have corners; nothing else has."""
    detector = keypoints.DETECTORS.get(name, detect)
    frame = np.full((160, 480), 90, np.uint8)
    for (u, v), contrast in SQUARES.items():
        frame[v - 7 : v + 7, u - 7 : u + 7] += np.uint8(contrast)
    frame = cv2.GaussianBlur(frame, (0, 0), 1)  # FAST finds nothing on sharp ones
    points = found(detector, frame)
    distances = np.abs(points[:, None] - list(SQUARES)).max(axis=2)
    assert len(points) and (distances.min(axis=1) < 14).all()
    noise = np.random.default_rng(0).integers(0, 256, frame.shape, np.uint8)
    assert 0.8 * FEW < len(found(detector, cv2.GaussianBlur(noise, (0, 0), 2))) <= FEW
    if ON_PURPOSE.get(name) != "order":
        contrasts = np.array(list(SQUARES.values()))[distances.argmin(axis=1)]
        assert (np.diff(contrasts) <= 0).all() and contrasts[0] == 130  # the strongest first
    mask = np.zeros(frame.shape, np.uint8)
    mask[:, 300:] = 255
    if ON_PURPOSE.get(name) != "mask":
        inside = found(detector, frame, mask)
        assert len(inside) and (inside[:, 0] > 299.5).all()
    if not isinstance(detector, type):
        assert len(detector(drive.frame(0), replace(THESIS, max_keypoints=0))) > 2000


def test_keypoints_that_cannot_be_pixels_are_refused(drive):
    for change, words in {
        lambda points: points[:, ::-1]: "outside the frame",
        lambda points: points / np.float32(480): "fractions",
        lambda points: points * np.float32(np.nan): "u nan",
        lambda points: points.astype(float): "float64",
        lambda points: points[:, None]: "float32 .*, 1, 2",
        lambda points: None: "NoneType",
    }.items():
        settings = replace(THESIS, detector=lambda *given: change(detect(*given)))  # noqa: B023
        with pytest.raises(InputError, match=f"frame 0: .*{words}"):
            odometry.run(drive, settings)
    corners = np.float32([[-1, -1], [480, 160]])
    np.testing.assert_array_equal(inputs.keypoints(corners, drive.frame(0), "detector"), corners)
    for outside in (corners - np.float32(0.01), corners + np.float32([[0.01, 0]])):
        with pytest.raises(InputError, match="outside"):
            inputs.keypoints(outside, drive.frame(0), "detector")


# Bad frames are flagged, and the run goes on


class Changed(Street):
    """A copy of a street with some frames replaced, which notes the frames read."""

    def __init__(self, sequence, replaced=None, poses=None, frames=None):
        self.intrinsics, self.read = sequence.intrinsics, []
        self.poses = (sequence.poses if poses is None else poses)[:frames]
        self.images = [
            (replaced or {}).get(index, image) for index, image in enumerate(sequence.images)
        ][:frames]

    def frame(self, index):
        self.read.append(index)
        return super().frame(index)


def standing(drive):
    sequence = Changed(drive, poses=np.insert(drive.poses, 5, drive.poses[4], axis=0))
    image = drive.frame(4).copy()
    image[0, 0] ^= 1
    sequence.images.insert(5, image)
    return sequence


def doubled(drive):
    """Frames 0 and 3 come twice and three times, as where a camera stands."""
    indices = np.insert(np.arange(len(drive)), [1, 4, 4], [0, 3, 3])
    sequence = Changed(drive, poses=drive.poses[indices])
    sequence.images = [drive.images[index] for index in indices]
    return sequence


def cut(drive):
    after = Street(4, start=500.0)
    turned = {5 + index: cv2.flip(image, 0) for index, image in enumerate(after.images)}
    return Changed(drive, turned, frames=9)


def excerpt(drive):
    """It starts in another direction."""
    return Changed(drive, poses=np.diag([-1.0, 1.0, -1.0, 1.0]) @ drive.poses, frames=3)


BLACK = np.zeros(Street.size, np.uint8)
BLOWN_OUT = np.random.RandomState(0).normal(255, 2, Street.size).clip(0, 255).astype(np.uint8)
NO_POINTS = {0: "no keypoints", **dict.fromkeys((1, 2), "no points; no keypoints")}
# {case: (sequence, settings, frames whose masks are empty, flags)}
BAD = {
    "black and blown out": (
        lambda drive: Changed(drive, {0: BLACK, 5: BLOWN_OUT}),
        {},
        (),
        {0: "flat frame", 1: "no points", 5: "flat frame"},
    ),
    "an empty mask": (Changed, {}, (4,), {4: "no keypoints"}),
    "empty masks": (excerpt, {}, range(3), NO_POINTS),
    "an empty filter": (excerpt, {"detector": keypoints.filtered}, range(3), NO_POINTS),
    "standing": (standing, {}, (), {5: "stationary"}),
    "equal frames": (doubled, {}, (), dict.fromkeys((1, 5, 6), "equal frame")),
    "a stalled camera": (
        lambda drive: Changed(drive, {5: drive.frame(4).copy()}),  # and drives on
        {},
        (),
        {5: "equal frame"},
    ),
    "a scene cut": (cut, {}, (), {5: "no agreement"}),
}


def flags(result):
    return {index: flag for index, flag in enumerate(result.frames["flag"]) if flag}


@pytest.mark.parametrize("case", BAD)
def test_bad_frames_are_flagged_and_keep_the_pose(drive, case):
    change, settings, empty, expected = BAD[case]
    sequence = change(drive)
    masks = [BLACK if index in empty else ~BLACK for index in range(len(sequence))]
    result = odometry.run(sequence, replace(SMALL, **settings), masks)
    assert flags(result) == expected
    np.testing.assert_array_equal(result.poses[0], odometry.start_pose(sequence))
    for index, moved in result.frames["updated"][1:].items():
        # without new keypoints, points are tracked further
        assert moved == (expected.get(index, "") in ("", "no keypoints"))
        assert np.array_equal(result.poses[index], result.poses[index - 1]) != moved
    if case == "equal frames":  # the path is that without them
        kept = np.delete(result.poses, [1, 5, 6], axis=0)
        np.testing.assert_array_equal(kept, odometry.run(drive, SMALL).poses)
        assert result.failed_steps == 0
    if case in (
        "black and blown out",
        "a stalled camera",
    ):  # the step to frame 6 is measured from frame 4
        assert result.frames["scale"][6] == pytest.approx(2 * result.frames["scale"][4])


CAMERA = np.array([[300.0, 0, 239.5], [0, 300.0, 79.5], [0, 0, 1]])
START = np.array([[0, 0, 1, 5.0], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])
WRONG = 250  # of the matches


def turning(settings, turn=3.0, scale=2.0):
    """A step of a camera that turns by so many degrees, and its true motion; 250 matches are wrong.

    The camera is the drive's, and moves by `scale`. Detector and tracker give made-up points.
    """
    random, motion = np.random.default_rng(0), np.eye(4)
    world = random.uniform([-8, -2, 6], [8, 1.6, 40], (2500, 3))
    motion[:3, :3] = cv2.Rodrigues(np.radians([0, turn, 0]))[0]
    motion[2, 3] = 1
    moved = world @ motion[:3, :3].T + motion[:3, 3]
    previous, current = (
        (points[:, :2] / points[:, 2:] * 300 + CAMERA[:2, 2]).astype(np.float32)
        for points in (moved, world)
    )
    seen = ((previous >= 0) & (previous < [480, 160])).all(axis=1)
    previous, current = previous[seen], current[seen]
    previous[:WRONG] = random.permutation(previous[:WRONG])
    calls = OPENCV._replace(
        detect=lambda *given: previous, track=lambda *given: (current, np.ones(len(current), bool))
    )
    follower = Odometry(CAMERA, settings, START, calls)
    for frame in random.integers(0, 256, (2, 160, 480), np.uint8):
        step = follower.step(frame, scale)
    motion[2, 3] = scale
    return step, motion


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_each_estimator_follows_a_turn_among_wrong_matches(name, seed):
    settings = replace(THESIS, estimator=ESTIMATORS[name].make, shuffle_seed=seed)
    step, motion = turning(settings)
    assert step.inliers[WRONG:].mean() > 0.95 and step.inliers[:WRONG].mean() < 0.1
    assert step.flags == [] and step.motion.pose_inliers > 0.85 * len(step.inliers)
    np.testing.assert_allclose(step.pose, START @ motion, rtol=0, atol=2e-3)
    sides = step.matches.previous, step.matches.current
    previous, current = (np.c_[side, np.ones(len(side))][WRONG:] for side in sides)
    assert np.abs((previous @ step.essential * current).sum(axis=1)).max() < 1e-3


def test_inliers_alone_vote_if_the_settings_say_so():
    votes = {}
    for name in ("thesis", "inliers"):
        step, _ = turning(replace(THESIS, estimator=ESTIMATORS[name].make))
        votes[name] = step.motion.pose_inliers
    sides = step.matches.current, step.matches.previous
    expected = [cv2.recoverPose(step.essential, *sides)[0]]
    expected += [cv2.recoverPose(step.essential, *(side[step.inliers] for side in sides))[0]]
    assert [*votes.values()] == expected and expected[0] > expected[1]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_too_large_turns_are_flagged_and_kept(name):
    settings = replace(THESIS, estimator=ESTIMATORS[name].make)
    for turn, expected in ((5.9, False), (6.1, True)):
        step, motion = turning(settings, turn)
        assert ("too large a turn" in step.flags) == expected and step.updated
        np.testing.assert_allclose(step.pose, START @ motion, rtol=0, atol=2e-2)


def test_steps_and_keypoints_at_the_limits_of_gate_and_redetection():
    count = len(turning(THESIS)[0].current)
    for scale, below, flags, detected in (
        (0.1, count, ["stationary"], None),
        (0.101, count + 1, [], count),
    ):
        step, _ = turning(replace(THESIS, redetect_below=below), scale=scale)
        assert (step.flags, step.detected) == (flags, detected)
    for agreeing, by_chance in ((11, True), (12, False)):  # of 100
        matches = Matches(None, None, 1.0, np.arange(100) < agreeing)
        assert matches.agree_by_chance() == by_chance


@pytest.mark.parametrize(
    "count, reason", [(4, "fewer than five correspondences"), (5, "several essential matrices")]
)
def test_too_few_correspondences_keep_the_pose(drive, count, reason):
    result = odometry.run(drive, replace(THESIS, max_keypoints=count, min_distance=40))
    full = result.frames[result.frames["tracked"] == count]
    assert (full["flag"].isin([reason, "no agreement"])).all() and (full["flag"] == reason).any()
    assert not result.frames["updated"].any()


def test_own_functions_take_the_places_of_opencvs_calls(drive):
    """Here a tracker that leaves out points, and a search that fails in one step."""
    few, outcomes = Changed(drive, frames=5), iter(range(1, 5))

    def tracks_of_the_right(previous, current, points, settings):
        tracked, was_found = OPENCV.track(previous, current, points, settings)
        return tracked, was_found & (points[:, 0] > 100)

    def failing(*arguments):
        return (None, None) if next(outcomes) == 3 else OPENCV.find_essential_matrix(*arguments)

    calls = OPENCV._replace(track=tracks_of_the_right, find_essential_matrix=failing)
    result, plain = odometry.run(few, calls=calls), odometry.run(few)
    assert (result.frames["tracked"] < plain.frames["tracked"])[1:].all()
    assert flags(result) == {3: "no essential matrix"}
    assert result.frames["updated"].tolist() == [False, True, True, False, True]
    np.testing.assert_array_equal(result.poses[3], result.poses[2])
    assert metrics.rmse(result.poses[:3], few.poses[:3]) < 0.05


@pytest.mark.parametrize(
    "form, said",
    [
        (lambda tracked, found: (tracked, found.astype(np.uint8)), "uint8"),  # OpenCV's status
        (lambda tracked, found: (tracked, found[:, None]), "bool"),
        (lambda tracked, found: (tracked, np.flatnonzero(found)), "int64"),
        (lambda tracked, found: (tracked[:, None], found), "float32"),
        (lambda tracked, found: (tracked[found], found[found]), "float32"),
        (lambda tracked, found: (tracked * np.nan, found), "finite"),
        (lambda tracked, found: (tracked, found, found), "tuple"),
        (lambda tracked, found: None, "NoneType"),
    ],
)
def test_what_an_own_tracker_returns_is_checked(drive, form, said):
    """NumPy takes 0 and 1 for the numbers of points, which gave a wrong path without a flag."""
    few = Changed(drive, frames=3)

    def own(previous, current, points, settings):
        found = points[:, 0] > 100
        return form(points + np.float32(1), found)

    with pytest.raises(InputError, match=f"frame 1: the tracker returned .*{said}"):
        odometry.run(few, calls=OPENCV._replace(track=own))


@pytest.mark.parametrize("number", [200, 100])
def test_the_detector_of_the_settings_holds_unless_detect_is_replaced(drive, number):
    few, settings = Changed(drive, frames=3), replace(THESIS, detector=keypoints.spread(200))
    calls = OPENCV._replace(track=lambda *given: OPENCV.track(*given))
    if number == 100:
        calls = calls._replace(detect=keypoints.spread(100))
    result = odometry.run(few, settings, calls=calls)
    assert (result.frames["detected"] == number).all()


class LeastMedian(VoteOfAll):
    """An estimator that brings its own search."""

    def search(self, current, previous, threshold):
        return cv2.findEssentialMat(current, previous, 1.0, (0, 0), cv2.LMEDS, 0.999)


@pytest.mark.parametrize("make", [separately, odometry.run_many], ids=["run", "run_many"])
def test_an_estimator_may_bring_its_own_search(drive, monkeypatch, make):
    few = Changed(drive, frames=4)
    ransac = counted(monkeypatch, cv2, "findEssentialMat")
    exact = counted(monkeypatch, sharing.opencv_exact, "find_essential_matrix")
    result = make(few, {"": (replace(THESIS, estimator=LeastMedian), None)})[""]
    assert not exact and {call[4] for call in ransac} == {cv2.LMEDS}
    assert metrics.rmse(result.poses, few.poses) < 0.1 and result.flagged.empty
    monkeypatch.setattr(
        LeastMedian, "search", lambda *points: (np.eye(3), np.zeros(len(points[1])))
    )
    assert set(flags(odometry.run(few, result.settings)).values()) == {"no agreement"}


# Settings


def test_settings_are_equal_elsewhere_and_so_is_their_record():
    made = replace(THESIS, detector=keypoints.filled(3, keypoints.spread(20)), estimator=refined)
    assert pickle.loads(pickle.dumps(made)) == made != replace(made, detector=keypoints.filled(3))
    record = made.record()
    assert (
        record["detector"] == "filled(3, spread(20))" and json.loads(json.dumps(record)) == record
    )
    assert record["estimator"] == "thesis_repro.odometry.estimators.refined"
    with pytest.raises(InputError, match="number of keypoints"):
        keypoints.spread(0)
    assert keypoints.spread(2**31 - 1).number == 2**31 - 1
    with pytest.raises(InputError, match="number of keypoints"):
        keypoints.spread(2**31)


@pytest.mark.parametrize("estimator", [None, refined])
def test_a_kept_step_has_the_points_that_were_found_and_tracked(drive, estimator):
    few, settings = Changed(drive, frames=4), replace(THESIS, estimator=estimator)
    plain, kept = odometry.run(few, settings), odometry.run(few, settings, keep_steps=True)
    np.testing.assert_array_equal(kept.poses, plain.poses)
    assert len(plain.steps) == 0 and len(kept.steps) == 4 and kept.steps[0].essential is None
    step = kept.steps[2]
    np.testing.assert_array_equal(step.keypoints, detect(few.frame(2)))
    assert {*map(tuple, step.previous)} <= {*map(tuple, kept.steps[1].keypoints)}


def test_shuffled_points_change_the_path_and_repeat_with_the_seed(drive):
    few = Changed(drive, frames=4)
    first, again, other, plain = (
        odometry.run(few, replace(SMALL, shuffle_seed=seed)).poses for seed in (0, 0, 1, None)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-6 and np.abs(first - plain).max() > 1e-6
    orders = [replace(SMALL, shuffle_seed=0).order(frame, 99).tolist() for frame in (1, 2)]
    assert orders[0] != orders[1] and sorted(orders[0]) == sorted(orders[1]) == [*range(99)]


# What the caller does with the arrays does not matter

SETTINGS = {
    "thesis": SMALL,
    "tracked on": replace(SMALL, redetect_below=10),
    "refined": replace(SMALL, estimator=refined),
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_a_step_does_not_depend_on_arrays_of_the_caller(drive, settings):
    intrinsics, buffer = drive.intrinsics.copy(), np.empty_like(drive.frame(0))
    plain, disturbed = Odometry(drive.intrinsics, settings), Odometry(intrinsics, settings)
    intrinsics[:] = 0
    for index in range(6):
        frame, scale, mask = drive.frame(index), 0.4 * (index > 0), Stripes(40)[index]
        buffer[:] = frame
        step, other = plain.step(frame, scale, mask), disturbed.step(buffer, scale, mask)
        np.testing.assert_array_equal(other.pose, step.pose)
        arrays = [buffer, other.pose, other.keypoints, other.previous, other.current, other.inliers]
        if index:
            arrays += [other.motion.rotation, other.motion.translation]
        for array in arrays:
            array[:] = 0


# Many runs in one pass


def variants():
    return {
        "stripes-7": (SMALL, Stripes(7)),
        "stripes-20": (SMALL, Stripes(20)),
        "all": (SMALL, None),
        "reduced": (replace(THESIS, max_keypoints=300), None),
        "refined": (replace(SMALL, estimator=refined), None),
        "kept": (replace(SMALL, redetect_below=450), None),  # tracks fractional positions on
        "few levels": (replace(SMALL, levels=1), None),
        "filter": (replace(SMALL, detector=keypoints.filtered, min_distance=4.5), Stripes(40)),
        "orb": (replace(SMALL, detector=keypoints.orb), Stripes(40)),
        "empty": (THESIS, lambda index, frame: BLACK),
    }


def assert_same(results, expected):
    for name, result in results.items():
        np.testing.assert_array_equal(result.poses, expected[name].poses)
        columns = [name for name in result.frames if not name.endswith("_seconds")]
        pd.testing.assert_frame_equal(result.frames[columns], expected[name].frames[columns])


def test_many_runs_in_one_pass_give_the_bits_of_separate_runs(drive, monkeypatch):
    bad = Changed(drive, {3: BLACK}, frames=5)
    strengths = counted(monkeypatch, sharing.cv2, "cornerMinEigenVal")
    together = odometry.run_many(bad, variants())
    assert len(strengths) <= len(bad)  # once a frame
    assert_same(together, separately(bad, variants()))
    assert (together["kept"].frames["detected"].isna()).any()
    assert together["all"].frames["track_seconds"].isna().all()
    assert together["orb"].poses[4, 2, 3] == pytest.approx(bad.poses[4, 2, 3], abs=0.1)


def counted(monkeypatch, module, name):
    """A list that gets an entry at each call of a function from now on."""
    calls, original = [], getattr(module, name)

    def counting(*arguments, **options):
        calls.append(arguments)
        return original(*arguments, **options)

    monkeypatch.setattr(module, name, counting)
    return calls


def test_runs_of_one_tracking_share_masks_and_essential_matrices(drive, monkeypatch):
    stripes, few = Stripes(20), Changed(drive, frames=6)
    runs = {
        (seed, make): (replace(SMALL, shuffle_seed=seed, estimator=make), stripes)
        for seed in (None, 1)
        for make in (None, refined)
    }
    searched = counted(monkeypatch, sharing.opencv_exact, "find_essential_matrix")
    asked = counted(monkeypatch, Stripes, "__getitem__")
    together = odometry.run_many(few, runs)
    assert len(searched) == 2 * (len(few) - 1) and len(asked) == len(few)
    assert_same(together, separately(few, runs))
    # the refined runs are equal for both orders here, the others differ
    assert len({result.poses.tobytes() for result in together.values()}) == 3


def test_a_mask_that_fails_ends_its_own_runs_alone(drive):
    few, wrong = Changed(drive, frames=4), [None, None, np.zeros((2, 2), np.uint8), None]
    runs = {"all": (THESIS, None), "striped": (THESIS, Stripes(20)), "wrong": (THESIS, wrong)}
    failed = {}
    together = odometry.run_many(few, runs, failed=failed)
    assert_same(together, separately(few, {name: runs[name] for name in ("all", "striped")}))
    assert list(failed) == ["wrong"] and "frame 2" in failed["wrong"]
    with pytest.raises(InputError, match="frame 2"):
        odometry.run_many(few, runs)


@dataclass(frozen=True)
class NewSettings(OdometrySettings):
    """Settings with one that nobody has said anything about."""

    invented: int = 0


@pytest.mark.parametrize(
    "setting, value, times", [("threshold", 0.001, 1), ("quality", 0.02, 2), ("invented", 1, 2)]
)
def test_runs_share_no_keypoints_if_a_setting_differs_that_may_matter(
    drive, monkeypatch, setting, value, times
):
    few, settings = Changed(drive, frames=3), NewSettings(max_keypoints=300)
    searched = counted(monkeypatch, sharing.corners, "detect")
    runs = {"first": (settings, None), "second": (replace(settings, **{setting: value}), None)}
    odometry.run_many(few, runs)
    assert len(searched) == times * len(few)


# Wrong input is named


@pytest.mark.parametrize(
    "setting, value",
    [
        ("estimator", "best"),
        ("detector", "fast"),
        ("detector", keypoints.spread),
        ("max_keypoints", -1),
        ("threshold", 0.0),
        ("quality", 0),
    ],
)
def test_wrong_settings_are_named(setting, value):
    with pytest.raises(InputError, match=setting):
        replace(THESIS, **{setting: value})


@pytest.mark.parametrize(
    "setting, most",
    [("max_keypoints", 2**31 - 1), ("redetect_below", 2**31 - 1), ("quality", 1)]
    + [("shuffle_seed", 2**32 - 1)],
)
def test_the_largest_number_of_a_setting_is_taken_and_the_next_refused(setting, most):
    assert getattr(replace(THESIS, **{setting: most}), setting) == most
    with pytest.raises(InputError, match=setting):
        replace(THESIS, **{setting: most + 1})


def test_wrong_frames_and_masks_are_named_and_leave_the_state(drive):
    follower, frame = Odometry(drive.intrinsics), drive.frame(1)
    follower.step(drive.frame(0))
    for arguments in (
        (frame, 0.4, np.zeros((10, 10), np.uint8)),
        (frame, 0.4, np.zeros(frame.shape)),
        (frame[:80], 0.4),
        (frame / 255, 0.4),
        (frame, float("nan")),
        (frame,),
        (frame, Fraction(-1, 2)),
        (None, 0.4),  # of cv2.imread, for a missing file
        (frame, 0.4, frame.tolist()),
    ):
        with pytest.raises(InputError, match="frame 1"):
            follower.step(*arguments)
    assert follower.step(frame, Fraction(2, 5), Stripes(40)[1] > 0).updated


def test_a_long_run_takes_faster_calls_with_the_same_bits(drive, monkeypatch):
    expected = odometry.run(drive, SMALL).frames
    odometry.run_many(drive, {"": (SMALL, None)})  # compiles them
    searched = counted(monkeypatch, sharing.opencv_exact, "find_essential_matrix")
    monkeypatch.setattr(odometry.runs, "FRAMES_TO_LOAD", len(drive) + 1)
    odometry.run(drive, SMALL)
    assert not searched
    monkeypatch.setattr(odometry.runs, "FRAMES_TO_LOAD", len(drive))
    frames = odometry.run(drive, SMALL).frames
    assert searched
    numbers = [name for name in frames if not name.endswith("seconds")]
    pd.testing.assert_frame_equal(frames[numbers], expected[numbers], check_exact=True)
    assert (frames[["track_seconds", "essential_seconds"]].sum() > 0).all()


@pytest.mark.parametrize("make", [odometry.run, odometry.run_many])
def test_wrong_sequences_and_masks_are_named_before_a_frame_is_read(drive, make):
    unread = Changed(drive)
    mask = np.full(drive.frame(0).shape, 255, np.uint8)
    for masks in (7, iter(()), (len(drive) - 1) * [mask], (len(drive) + 1) * [mask]):
        arguments = (THESIS, masks) if make is odometry.run else ({"": (THESIS, masks)},)
        with pytest.raises(InputError, match="masks: "):
            make(unread, *arguments)
        with pytest.raises(InputError, match="sequence: "):
            make("00", *arguments)
    assert unread.read == []


def test_frames_stay_the_callers_and_one_buffer_may_hold_them_all(drive):
    """A decoder fills one array again; a camera hands out read-only views of one memory."""
    expected = odometry.run(Changed(drive, frames=4), SMALL).poses
    memory = bytearray(drive.frame(0).size)
    buffer = np.frombuffer(memory, np.uint8).reshape(drive.size)
    view = np.frombuffer(memoryview(memory).toreadonly(), np.uint8).reshape(drive.size)

    class Camera(Changed):
        def frame(self, index):
            buffer[:] = super().frame(index)
            return self.shown

    for shown in (buffer, view, view[:]):
        camera = Camera(drive, frames=4)
        camera.shown = shown
        together = odometry.run_many(camera, {"": (SMALL, None)})
        np.testing.assert_array_equal(odometry.run(camera, SMALL).poses, expected)
        np.testing.assert_array_equal(together[""].poses, expected)
    assert buffer.flags.writeable


def test_no_corners_are_kept_of_memory_that_others_can_change(drive):
    images = [drive.frame(0), drive.frame(5)]
    memory = bytearray(images[0].size)
    view = np.frombuffer(memoryview(memory).toreadonly(), np.uint8).reshape(images[0].shape)
    for image in images:
        memory[:] = image.tobytes()
        np.testing.assert_array_equal(sharing.corners.detect(view), detect(image))


def test_a_float_mask_is_named_where_not_all_of_the_frame_is_visible(drive):
    few = Changed(drive, frames=2)
    few.visible = lambda index: np.full(drive.size, 255, np.uint8)
    with pytest.raises(InputError, match="frame 0: the mask is float32"):
        odometry.run(few, SMALL, masks=lambda index, frame: np.ones(frame.shape, np.float32))


def test_masks_may_be_a_method_that_is_called_once_a_frame(drive):
    few, stripes, called = Changed(drive, frames=4), Stripes(40), []

    class Network:
        def mask(self, index, frame):
            assert np.array_equal(frame, drive.frame(index))
            frame[:] = 0  # its own copy
            called.append(index)
            return stripes[index]

    expected, network = odometry.run(few, masks=stripes).poses, Network()
    assert np.array_equal(odometry.run(few, masks=network.mask).poses, expected)
    runs = {"a": (THESIS, network.mask), "b": (SMALL, network.mask), "c": (THESIS, None)}
    results = odometry.run_many(few, runs)
    assert sorted(called) == sorted(2 * list(range(4)))
    assert np.array_equal(results["a"].poses, expected)
    assert not np.array_equal(results["c"].poses, expected)


def test_a_result_writes_its_path_and_tells_it_in_a_few_lines(drive, tmp_path):
    result = odometry.run(drive, keep_steps=True)
    assert len(repr(result).splitlines()) == 3 and f"{len(drive)} frames" in repr(result)
    for step in result.steps:
        assert len(repr(step).splitlines()) == 3 and f"frame {step.frame}," in repr(step)
    with pytest.raises(InputError, match="path.tum"):  # this street has no times
        result.write_tum(tmp_path / "path.tum")
    assert not list(tmp_path.iterdir())
    result.write_kitti(tmp_path / "path.txt")
    assert np.array_equal(read_poses(tmp_path / "path.txt"), result.poses)
    times = 2 + 0.5 * np.arange(len(drive))
    replace(result, times=times).write_tum(tmp_path / "path.tum")
    assert np.array_equal(np.loadtxt(tmp_path / "path.tum")[:, 0], times)
