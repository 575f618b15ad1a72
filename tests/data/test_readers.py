"""Any content of a file is read to valid values or refused.

It is refused with one line that names it.
"""

import string

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thesis_repro.data import geometry, kitti_odometry, trajectories
from thesis_repro.errors import InputError

# the same examples in every run, and no time limits
settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    max_examples=200,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("repeatable")

NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.integers(-(10**400), 10**400).map(str)
WORDS = NUMBERS.map(str) | st.sampled_from(
    ["nan", "inf", "1e999", "-0", "1_0", "0x1", "٣", "½", "", "#", "P0:"]
)
# any text, and text that looks like a file of poses, times or calibration
TEXTS = (
    st.text()
    | st.text(string.digits + " .-+eE\n\r\t\x0b\x1c\x85\u2028nanif")
    | st.lists(st.lists(WORDS, max_size=13).map(" ".join), max_size=5).map("\n".join)
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("readers") / "file.txt"


def read(function, path, text, *arguments):
    """Result of a reader for a file with this text.

    None if it raises InputError with the file's name.
    """
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    try:
        return function(path, *arguments)
    except InputError as error:
        assert str(path) in str(error) and str(error).isprintable()
        return None


@given(TEXTS | st.binary() | st.lists(WORDS, min_size=12, max_size=12).map(" ".join))
def test_any_text_as_poses(path, text):
    poses = read(trajectories.read_poses, path, text)
    if poses is not None:
        rotations = poses[:, :3, :3]
        assert poses.shape[1:] == (4, 4) and len(poses) and np.isfinite(poses).all()
        assert (
            np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
            <= geometry.ROTATION_TOLERANCE
        )
        assert (np.linalg.det(rotations) > 0).all() and (poses[:, 3] == [0, 0, 0, 1]).all()


POSE, BAD_POSE = "1 0 0 0 0 1 0 0 0 0 1 0\n", "2 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    "function, text, line",
    [
        (trajectories.read_poses, f"\n\n{POSE}\n{BAD_POSE}", 5),
        (trajectories.read_poses, f"\n{POSE}1 2 3\n", 3),
        (trajectories.read_poses, f"{POSE}# no comment\n", 2),
        (trajectories.read_times, "0\n\n1\n \n1\n", 5),
        (trajectories.read_times, "0\n\n1\nnan\n", 4),
    ],
)
def test_messages_count_all_lines_of_a_file(path, function, text, line):
    path.write_text(text)
    with pytest.raises(InputError, match=f"{path}, line {line}: "):
        function(path)


@given(
    TEXTS | st.binary() | st.lists(WORDS, min_size=11, max_size=13).map(" ".join),
    st.booleans(),
    st.sampled_from(["P0", "P2"]),
)
def test_any_text_as_calibration(path, text, with_key, camera):
    if with_key and isinstance(text, str):
        text = f"P2: {text}\nP0: {text}"
    read_camera = kitti_odometry.read_camera
    lens = read(read_camera, path, text, camera)
    if lens is not None:
        matrix = lens.matrix
        assert matrix.shape == (3, 3) and np.isfinite(matrix).all() and (np.diag(matrix) > 0).all()
        assert np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])


@given(
    st.lists(
        st.tuples(*[st.floats(-3, 3)] * 3, *[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=20
    )
)
def test_written_trajectories_are_read_back_to_the_bit(path, motions):
    poses = np.tile(np.eye(4), (len(motions), 1, 1))
    for pose, motion in zip(poses, np.array(motions)):
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(motion[:3])[0], motion[3:]
    trajectories.write_kitti_poses(path, poses)
    assert np.array_equal(trajectories.read_poses(path), poses)
