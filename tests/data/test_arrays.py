"""Frames in memory stand for a sequence, with the same bits."""

from datetime import datetime

import numpy as np
import pytest
from street import Street

import thesis_repro as tr
from thesis_repro.errors import InputError

POSES = np.tile(np.eye(4), (6, 1, 1))
POSES[:, :3, 3] = np.outer(np.arange(6), [3, 4, 12])


@pytest.fixture(scope="module")
def street():
    return Street(6)


def drive(street, **lengths):
    return tr.Sequence.from_arrays(street.images, street.intrinsics, **lengths)


def test_arrays_give_the_bits_of_a_sequence(street):
    expected = tr.run(street).poses
    stack = np.array(street.images)
    whole = tr.Sequence.from_arrays(stack, street.intrinsics.tolist(), poses=street.poses)
    np.testing.assert_array_equal(tr.run(whole).poses, expected)
    np.testing.assert_array_equal(tr.run_many(whole, {"": (tr.THESIS, None)})[""].poses, expected)
    assert stack.flags.writeable and whole.size == street.size
    np.testing.assert_array_equal(whole[-1], street.images[-1])
    assert [frame.sum() for frame in whole] == [image.sum() for image in street.images]


def test_what_it_is_is_shown(street):
    assert repr(drive(street)) == "Sequence frames in memory: 6 frames without true poses"
    named = drive(street, poses=POSES, name="walk")
    assert repr(named) == "Sequence walk: 6 frames with true poses"
    odometry = tr.Odometry(street.intrinsics)
    for _ in range(2):
        odometry.step(street.frame(0), 1.0)
    assert "2 frames" in repr(odometry) and "[0. 0. 0.] m" in repr(odometry)


@pytest.mark.parametrize(
    "lengths, expected",
    [
        ({}, [0, 1, 1, 1, 1, 1]),
        ({"scales": range(6)}, [0, 1, 2, 3, 4, 5]),
        ({"speed": 5, "times": [0, 1, 2, 4, 5, 6]}, [0, 5, 5, 10, 5, 5]),
        ({"poses": POSES}, [0, 13, 13, 13, 13, 13]),
    ],
)
def test_steps_have_the_lengths_that_were_given(street, lengths, expected):
    result = tr.run(drive(street, **lengths))
    np.testing.assert_array_equal(result.frames["scale"], expected)
    np.testing.assert_array_equal(result.poses[0], np.eye(4))


@pytest.mark.parametrize(
    "wrong",
    [
        {"frames": []},
        {"frames": iter([1])},
        {"scales": [1, 2]},
        {"scales": [np.nan] * 6},
        {"scales": [1] * 6, "speed": 3},
        {"speed": 3},
        {"poses": np.ones((6, 4, 4))},
        {"poses": np.eye(4)},
        {"times": [1]},
        {"times": [5] * 6, "scales": [1] * 6},
        {"times": [0, 1, 2, 3, 5, 4], "speed": 3},
        {"times": np.arange(6).astype("datetime64[s]"), "speed": 3},
        {"times": np.arange(6).astype("timedelta64[ms]"), "speed": 3},
        {"times": [datetime(2026, 1, day) for day in range(1, 7)], "speed": 3},
        *({"speed": speed, "times": range(6)} for speed in (0, -3, np.nan, "3", [3] * 6)),
    ],
)
def test_wrong_arrays_are_named(street, wrong):
    given = {"frames": street.images, "intrinsics": street.intrinsics} | wrong
    with pytest.raises(InputError, match=next(iter(wrong))):
        tr.Sequence.from_arrays(**given)


@pytest.mark.parametrize(
    "unit, pause, impossible", [(1, 0, 0), (1, 9, 1), (1e3, 0, 5), (1e9, 0, 5)]
)
def test_times_in_other_units_and_pauses_are_told(street, caplog, unit, pause, impossible):
    drive(street, speed=8, times=unit * 0.1 * np.arange(6) + [0, 0, 0, 0, 0, pause])
    assert [f"{impossible} of 5 steps are impossible" in line for line in caplog.messages] == (
        [True] if impossible else []
    )


def test_more_masks_than_frames_are_refused(street):
    with pytest.raises(InputError, match="masks: 7 for 6 frames"):
        tr.run(drive(street), masks=[np.ones(street.size, bool)] * 7)


def test_without_poses_there_is_no_truth_and_no_folder_of_masks(street, tmp_path):
    with pytest.raises(InputError, match="poses"):
        drive(street).poses  # noqa: B018
    with pytest.raises(InputError, match="list"):
        tr.LabelMasks(tmp_path, drive(street), 3)


def test_the_digest_changes_with_every_part(street):
    others = [
        tr.Sequence.from_arrays([*street.images[:5], street.images[0]], street.intrinsics),
        tr.Sequence.from_arrays(street.images, 2 * street.intrinsics),
        drive(street, scales=range(6)),
        drive(street, poses=street.poses),
    ]
    digests = {sequence.digest() for sequence in (drive(street), drive(street), *others)}
    assert len(digests) == 5
