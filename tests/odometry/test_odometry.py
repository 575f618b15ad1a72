"""The odometry against PySLAM's runs, its rules for bad frames, and its settings."""

import copy
import pickle
from dataclasses import dataclass, replace
from fractions import Fraction

import cv2
import numpy as np
import pandas as pd
import pytest
from street import Street, Stripes

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.mask_files import MaskFolder
from thesis_repro.odometry import THESIS, Odometry, OdometrySettings, keypoints, metrics, sharing
from thesis_repro.odometry.odometry import OPENCV, normalise, track
from thesis_repro.odometry.types import ROTATION_COLUMNS

SMALL = replace(THESIS, max_keypoints=500)  # quicker
COUNTS = {
    "points": "n_kps_to_lk",
    "detected": "n_detected",
    "tracked": "n_tracked",
    "inliers": "n_inliers_E",
    "pose_inliers": "n_inliers_recoverPose",
}


@pytest.mark.real
@pytest.mark.parametrize(
    "sequence, errors",
    [
        ("00", {"00": (1.700609, 0.705170), "00_masked": (1.811076, 0.794264)}),
        ("06", {"06": (0.357133, 0.146225)}),
    ],
)
def test_agrees_with_pyslam_on_every_frame(kitti_real, reference, sequence, errors):
    kitti = Sequence(kitti_real, sequence)
    runs = {
        run: (THESIS, MaskFolder(reference / "masks_00", kitti) if "masked" in run else None)
        for run in errors
    }
    for run, result in odometry.run_many(kitti, runs).items():
        expected = pd.read_csv(reference / f"{run}.csv")
        assert len(result.frames) == len(expected) == len(kitti)
        for ours, theirs in COUNTS.items():
            np.testing.assert_array_equal(
                result.frames[ours].to_numpy(float, na_value=np.nan), expected[theirs]
            )
        columns = ["x", "y", "z", *ROTATION_COLUMNS]
        np.testing.assert_allclose(result.frames[columns], expected[columns], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            result.frames["scale"][1:], expected["gt_scale"][1:], rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(
            result.frames["updated"][1:], expected["pose_updated"][1:] == 1
        )
        assert (
            metrics.rmse(result.poses, kitti.poses),
            metrics.mae(result.poses, kitti.poses),
        ) == pytest.approx(errors[run], abs=5e-7)
        assert result.flagged.empty


@pytest.fixture(scope="module")
def drive():
    return Street()


def pyslam_with_bare_calls(sequence, masks=None):
    """The thesis's algorithm in OpenCV calls: (a table of counts with one row a frame, poses)."""
    rotation, position, points, previous = np.eye(3), np.zeros((3, 1)), None, None
    inverse = np.linalg.inv(sequence.intrinsics)
    inverse[:2, 2] = -sequence.intrinsics[:2, 2] / np.diag(sequence.intrinsics)[:2]
    counts, poses = [], []
    for index in range(len(sequence)):
        frame, row = sequence.frame(index), {}
        if previous is not None:
            tracked, status, _ = cv2.calcOpticalFlowPyrLK(
                previous, frame, points, None, winSize=(21, 21), maxLevel=3, criteria=(3, 30, 0.01)
            )
            old, new = points[status == 1], tracked[status == 1]
            old_n, new_n = (
                (inverse @ np.c_[side.astype(float), np.ones(len(side))].T).T[:, :2]
                for side in (old, new)
            )
            matrix, inliers = cv2.findEssentialMat(
                new_n, old_n, focal=1, pp=(0, 0), method=cv2.RANSAC, prob=0.999, threshold=0.0003
            )
            votes, turn, shift, _ = cv2.recoverPose(matrix, new_n, old_n, focal=1, pp=(0, 0))
            scale = np.linalg.norm(sequence.poses[index, :3, 3] - sequence.poses[index - 1, :3, 3])
            if scale > 0.1:
                position = position + scale * rotation @ shift
                rotation = rotation @ turn
            row = {
                "points": len(points),
                "tracked": len(new),
                "inliers": inliers.sum(),
                "pose_inliers": votes,
            }
        if previous is None or len(new) < 2000:
            points = cv2.goodFeaturesToTrack(
                frame, 2000, 0.01, 3, blockSize=5, mask=None if masks is None else masks[index]
            )
        else:
            points = new.reshape(-1, 1, 2)
        previous = frame
        counts.append(row)
        poses.append(np.vstack([np.hstack([rotation, position]), [0, 0, 0, 1]]))
    return pd.DataFrame(counts), np.array(poses)


@pytest.mark.parametrize("masks", [None, Stripes(40)])
def test_agrees_with_the_same_calls_of_opencv(drive, masks):
    counts, poses = pyslam_with_bare_calls(drive, masks)
    result = odometry.run(drive, masks=masks)
    for column in counts:
        np.testing.assert_array_equal(
            result.frames[column].to_numpy(float, na_value=np.nan), counts[column]
        )
    np.testing.assert_allclose(result.poses, poses, rtol=0, atol=1e-12)
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
        expected = cv2.goodFeaturesToTrack(
            image,
            settings.max_keypoints,
            settings.quality,
            settings.min_distance,
            mask=masks.get(mask),
            blockSize=settings.block_size,
        )
        np.testing.assert_array_equal(
            shared.detect(image, settings, masks.get(mask)),
            np.empty((0, 2)) if expected is None else expected[:, 0],
        )


def test_tracks_have_opencvs_bits(drive):
    frame = drive.frame(3)
    points = keypoints.detect(frame)
    # at -40 a window leaves the frame
    for shift, window in ((3, 21), (12, 21), (-40, 21), (12, 11)):
        moved, settings = np.roll(frame, shift, axis=1), replace(THESIS, window=window)
        for ours, expected in zip(
            sharing.track(frame, moved, points, settings), track(frame, moved, points, settings)
        ):
            np.testing.assert_array_equal(ours, expected)


def test_a_mask_in_the_detector_fills_the_limit_and_a_filter_does_not(drive):
    inside, filtered = (
        keypoints.detect(drive.frame(0), replace(SMALL, mask_mode=mode), Stripes(40)[0])
        for mode in ("detect", "filter")
    )
    assert len(inside) == 500 and 100 < len(filtered) < 400


def nearest_neighbours(points):
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return np.sort(distances, axis=1)[:, 1]


def test_spread_keypoints_are_as_many_and_farther_apart(drive):
    frame, few = drive.frame(0), replace(THESIS, max_keypoints=100)
    everything = keypoints.detect(frame, replace(THESIS, max_keypoints=0))
    corners = keypoints.detect(frame, replace(THESIS, max_keypoints=0, min_distance=0))
    spread = keypoints.detect(frame, replace(few, choice="spread"))
    assert len(spread) == len(everything[:100]) == 100
    assert {*map(tuple, spread)} <= {*map(tuple, corners)}
    assert nearest_neighbours(spread).min() > 2 * nearest_neighbours(everything[:100]).min()
    # the strongest one is always taken, and as many as there are if those are fewer
    np.testing.assert_array_equal(spread[0], everything[0])
    all_spread = keypoints.detect(frame, replace(THESIS, max_keypoints=10**6, choice="spread"))
    np.testing.assert_array_equal(all_spread, everything)


def test_a_filled_mask_leaves_no_field_empty(drive):
    frame, mask = drive.frame(0), np.zeros(drive.size, np.uint8)
    mask[:, :240] = 255
    plain = keypoints.detect(frame, THESIS, mask)
    filled = keypoints.detect(frame, replace(THESIS, fill=3), mask)
    np.testing.assert_array_equal(filled[: len(plain)], plain)
    everything = keypoints.detect(frame, replace(THESIS, max_keypoints=0))
    for row in range(5):
        for column in range(16):
            counts = [
                (points // (30, 32) == (column, row)).all(axis=1).sum()
                for points in (plain, filled, everything)
            ]
            assert counts[1] == max(counts[0], min(3, counts[2])), (row, column, counts)
    assert nearest_neighbours(filled).min() >= 3


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


def flags(result):
    return {index: flag for index, flag in enumerate(result.frames["flag"]) if flag}


def test_black_and_blown_out_frames_are_bridged(drive):
    noise = np.random.RandomState(0).normal(255, 2, drive.frame(0).shape)
    black, blown_out = np.zeros_like(drive.frame(0)), np.clip(noise, 0, 255).astype(np.uint8)
    result = odometry.run(Changed(drive, {0: black, 5: blown_out}))
    assert flags(result) == {0: "flat frame", 1: "no points", 5: "flat frame"}
    np.testing.assert_array_equal(result.poses[[0, 1, 5]], result.poses[[0, 0, 4]])
    # the step to frame 6 is measured from frame 4
    assert result.frames["scale"][6] == pytest.approx(2 * result.frames["scale"][4])
    assert result.frames["updated"][[2, 3, 4, 6]].all()


@pytest.mark.parametrize("estimator", ["thesis", "inliers", "refined"])
def test_too_large_turns_are_flagged_and_kept(drive, monkeypatch, estimator):
    settings = replace(THESIS, estimator=estimator)
    plain = odometry.run(drive, settings)
    monkeypatch.setattr(odometry.odometry, "MAX_TURN", 0.05)
    flagged = odometry.run(drive, settings)
    assert plain.flagged.empty and set(flags(flagged).values()) == {"too large a turn"}
    np.testing.assert_array_equal(flagged.poses, plain.poses)


def test_an_empty_mask_keeps_the_tracked_points(drive):
    masks = [
        np.full(drive.frame(0).shape, 0 if index == 4 else 255, np.uint8) for index in range(10)
    ]
    result = odometry.run(drive, masks=masks)
    assert flags(result) == {4: "no keypoints"}
    assert result.frames["detected"][4] == 0
    assert result.frames["points"][5] == result.frames["tracked"][4]
    assert result.frames["updated"][1:].all()


@pytest.mark.parametrize("mode", ["detect", "filter"])
def test_empty_masks_alone_keep_the_first_pose(drive, mode):
    start = np.diag([-1.0, 1.0, -1.0, 1.0])
    # an excerpt that starts in another direction
    backwards = Changed(drive, poses=start @ drive.poses, frames=4)
    result = odometry.run(
        backwards, replace(THESIS, mask_mode=mode), [np.zeros(drive.frame(0).shape, np.uint8)] * 4
    )
    np.testing.assert_array_equal(result.poses, [start] * 4)
    assert result.flagged.to_dict() == {"no keypoints": 4, "no points": 3}


@pytest.mark.parametrize(
    "count, reason", [(4, "fewer than five correspondences"), (5, "several essential matrices")]
)
def test_too_few_correspondences_keep_the_pose(drive, count, reason):
    result = odometry.run(drive, replace(THESIS, max_keypoints=count, min_distance=40))
    full = result.frames[result.frames["tracked"] == count]
    assert (
        len(full)
        and (full["flag"].isin([reason, "no agreement"])).all()
        and (full["flag"] == reason).any()
    )
    assert not result.frames["updated"].any()


def test_no_essential_matrix_keeps_the_pose(drive):
    outcomes = iter(range(1, 10))

    def failing(*arguments):
        return (None, None) if next(outcomes) == 3 else OPENCV.find_essential_matrix(*arguments)

    calls = OPENCV._replace(find_essential_matrix=failing)
    result = odometry.run(drive, calls=calls)
    assert flags(result) == {3: "no essential matrix"}
    np.testing.assert_array_equal(result.poses[3], result.poses[2])
    assert result.frames["updated"][[2, 4, 6]].all()


def test_own_matches_take_the_places_of_opencvs_calls(drive):
    """The true motion of points in the distance, in place of the tracker."""
    few = Changed(drive, frames=4)

    def exact_track(previous, current, points, settings):
        tracked, found = OPENCV.track(previous, current, points, settings)
        return tracked, found & (points[:, 0] > 100)

    result = odometry.run(few, calls=OPENCV._replace(track=exact_track))
    plain = odometry.run(few)
    assert (result.frames["tracked"] < plain.frames["tracked"])[1:].all()
    assert metrics.rmse(result.poses, few.poses) < 0.05


def standing(drive):
    sequence = Changed(drive, poses=np.insert(drive.poses, 5, drive.poses[4], axis=0))
    sequence.images.insert(5, drive.frame(4).copy())
    return sequence


def cut(drive):
    after = Street(4, start=500.0)
    return Changed(
        drive, {5 + index: cv2.flip(after.frame(index), 0) for index in range(4)}, frames=9
    )


@pytest.mark.parametrize(
    "change, flag", [(standing, ["stationary", "no essential matrix"]), (cut, ["no agreement"])]
)
def test_a_standing_camera_and_a_scene_cut_keep_the_pose(drive, change, flag):
    result = odometry.run(change(drive))
    assert flags(result)[5] in flag
    np.testing.assert_array_equal(result.poses[5], result.poses[4])
    assert result.frames["updated"][6:].all()


# Settings


def test_shuffled_points_change_the_path_and_repeat_with_the_seed(drive):
    few = Changed(drive, frames=4)
    first, again, other, plain = (
        odometry.run(few, replace(SMALL, shuffle_seed=seed)).poses for seed in (0, 0, 1, None)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-6 and np.abs(first - plain).max() > 1e-6


def test_inliers_of_shuffled_points_are_in_their_order(drive):
    follower = Odometry(drive.intrinsics, replace(THESIS, shuffle_seed=3))
    follower.step(drive.frame(0))
    step = follower.step(drive.frame(1), 0.4)
    matrix = np.cross(np.eye(3), step.motion.translation).T @ step.motion.rotation
    current, previous = (
        np.c_[normalise(side, drive.intrinsics), np.ones(len(side))]
        for side in (step.current, step.previous)
    )
    lines, others = current @ matrix.T, previous @ matrix
    distances = np.abs((previous * lines).sum(axis=1)) / np.sqrt(
        (lines[:, :2] ** 2).sum(axis=1) + (others[:, :2] ** 2).sum(axis=1)
    )
    np.testing.assert_array_equal(step.inliers, distances < THESIS.threshold)


def test_another_detector_follows_the_drive(drive):
    few = Changed(drive, frames=5)
    result = odometry.run(few, replace(THESIS, detector="orb"))
    assert metrics.rmse(result.poses, few.poses) < 0.1
    assert np.abs(result.poses - odometry.run(few).poses).max() > 1e-9


# What the caller does with the arrays does not matter

SETTINGS = {
    "thesis": THESIS,
    "tracked on": replace(THESIS, redetect_below=10),
    "refined": replace(THESIS, estimator="refined"),
}


def arrays_of(step):
    motion = step.motion.rotation, step.motion.translation, step.inliers
    arrays = step.pose, step.keypoints, step.previous, step.current, *motion
    return [array for array in arrays if array is not None]


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
        for array in (buffer, *arrays_of(other)):
            array[:] = 0


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda odometry: pickle.loads(pickle.dumps(odometry))],
    ids=["deepcopy", "pickle"],
)
def test_a_copy_goes_on_with_the_same_bits(drive, copied):
    first = Odometry(drive.intrinsics, replace(SMALL, estimator="refined"))
    masks = Stripes(40)
    for index in range(3):
        first.step(drive.frame(index), 0.4, masks[index])
    second = copied(first)
    for index in range(3, 6):
        poses = [each.step(drive.frame(index), 0.4, masks[index]).pose for each in (first, second)]
        np.testing.assert_array_equal(*poses)


def test_results_and_steps_equal_only_themselves(drive):
    few = Changed(drive, frames=2)
    first, second = odometry.run(few, SMALL), odometry.run(few, SMALL)
    assert first == first != second and len({first, second}) == 2
    follower = Odometry(drive.intrinsics, SMALL)
    steps = [follower.step(drive.frame(index), 0.4) for index in range(3)]
    assert steps.index(steps[2]) == 2 and len({step.motion for step in steps[1:]}) == 2


# Many runs in one pass


def variants():
    runs = {f"stripes-{width}": (SMALL, Stripes(width)) for width in (7, 20)}
    runs["all"] = (THESIS, None)
    runs["reduced"] = (replace(THESIS, max_keypoints=300), None)
    runs["refined"] = (replace(SMALL, estimator="refined"), None)
    runs["kept"] = (replace(SMALL, redetect_below=450), None)  # tracks fractional positions on
    runs["filter"] = (replace(SMALL, mask_mode="filter", min_distance=4.5), Stripes(40))
    runs["orb"] = (replace(SMALL, detector="orb"), Stripes(40))
    runs["empty"] = (THESIS, [np.zeros((160, 480), np.uint8)] * 10)
    return runs


def assert_same(result, expected):
    np.testing.assert_array_equal(result.poses, expected.poses)
    columns = [name for name in result.frames if not name.endswith("_seconds")]
    pd.testing.assert_frame_equal(result.frames[columns], expected.frames[columns])


def test_many_runs_in_one_pass_give_the_bits_of_separate_runs(drive):
    bad = Changed(drive, {4: np.zeros_like(drive.frame(0))}, frames=7)
    together = odometry.run_many(bad, variants())
    for name, (settings, masks) in variants().items():
        assert_same(together[name], odometry.run(bad, settings, masks))
    assert (together["kept"].frames["detected"].isna()).any()
    assert together["all"].frames["track_seconds"].isna().all()


class Counted(Stripes):
    """Stripes that note the frames whose mask was asked for."""

    def __init__(self, width):
        super().__init__(width)
        self.asked = []

    def __getitem__(self, index):
        self.asked.append(index)
        return super().__getitem__(index)


def test_runs_of_one_tracking_share_masks_and_essential_matrices(drive, monkeypatch):
    searched = []
    stripes, few = Counted(20), Changed(drive, frames=6)
    runs = {
        (seed, estimator): (replace(THESIS, shuffle_seed=seed, estimator=estimator), stripes)
        for seed in (None, 1)
        for estimator in ("thesis", "refined")
    }
    original = sharing.opencv_exact.find_essential_matrix

    def counting(*arguments):
        searched.append(1)
        return original(*arguments)

    monkeypatch.setattr(sharing.opencv_exact, "find_essential_matrix", counting)
    together = odometry.run_many(few, runs)
    assert stripes.asked == list(range(len(few))) and len(searched) == 2 * (len(few) - 1)
    for name, (settings, masks) in runs.items():
        assert_same(together[name], odometry.run(few, settings, masks))
    # the refined runs are equal for both orders here, the others differ
    assert len({together[name].poses.tobytes() for name in runs}) == 3


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
    searched = []
    original = sharing.keypoints.detect

    def counting(*arguments):
        searched.append(1)
        return original(*arguments)

    monkeypatch.setattr(sharing.keypoints, "detect", counting)
    runs = {"first": (settings, None), "second": (replace(settings, **{setting: value}), None)}
    odometry.run_many(few, runs)
    assert len(searched) == times * len(few)


@pytest.mark.parametrize(
    "setting, value",
    [
        ("estimator", "best"),
        ("detector", "fast"),
        ("max_keypoints", -1),
        ("threshold", 0.0),
        ("choice", "best"),
    ],
)
def test_wrong_settings_are_named(setting, value):
    with pytest.raises(InputError, match=setting):
        replace(THESIS, **{setting: value})


def test_a_mask_may_be_of_booleans(drive):
    masks = Stripes(40)
    booleans = [masks[index] > 0 for index in range(len(drive))]
    assert_same(odometry.run(drive, SMALL, masks), odometry.run(drive, SMALL, booleans))


def test_wrong_frames_and_masks_are_named(drive):
    follower = Odometry(drive.intrinsics)
    follower.step(drive.frame(0))
    frame = drive.frame(1)
    for arguments in (
        (frame, 0.4, np.zeros((10, 10), np.uint8)),
        (frame, 0.4, np.zeros(frame.shape)),
        (frame[:80], 0.4),
        (frame / 255, 0.4),
        (frame, float("nan")),
        (frame, None),
        (frame, Fraction(-1, 2)),
        (None, 0.4),  # of cv2.imread, for a missing file
        (frame, 0.4, frame.tolist()),
    ):
        with pytest.raises(InputError, match="frame 1"):
            follower.step(*arguments)
    assert follower.step(frame, Fraction(2, 5)).updated  # the state is unchanged


@pytest.mark.parametrize("sequence", ["00", None])
def test_wrong_sequences_are_named(sequence):
    with pytest.raises(InputError, match="sequence"):
        odometry.run(sequence)


@pytest.mark.parametrize(
    "masks", [lambda index: None, iter(()), [None] * 9], ids=["function", "iterator", "short"]
)
def test_wrong_masks_are_named_before_a_frame_is_read(drive, masks):
    unread = Changed(drive)
    with pytest.raises(InputError, match="masks: "):
        odometry.run(unread, masks=masks)
    with pytest.raises(InputError, match="masks: "):
        odometry.run_many(unread, {"": (THESIS, masks)})
    assert unread.read == []
