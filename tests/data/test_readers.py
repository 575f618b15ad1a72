"""Any content of a file is read to valid values or refused.

It is refused with one line that names it.
"""

import re
import string

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from thesis_repro.data import kitti, trajectories
from thesis_repro.errors import InputError
from thesis_repro.running import files

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
            <= trajectories.ROTATION_TOLERANCE
        )
        assert (np.linalg.det(rotations) > 0).all() and (poses[:, 3] == [0, 0, 0, 1]).all()


@given(TEXTS | st.binary())
def test_any_text_as_times(path, text):
    times = read(trajectories.read_times, path, text)
    if times is not None:
        assert (
            times.ndim == 1
            and len(times)
            and np.isfinite(times).all()
            and (np.diff(times) > 0).all()
        )


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
    st.sampled_from(["image_0", "image_2", "drive"]),
)
def test_any_text_as_calibration(path, text, with_key, camera):
    if with_key and isinstance(text, str):
        text = f"P2: {text}\nP0: {text}"
    matrix = read(kitti.read_intrinsics, path, text, camera)
    if matrix is not None:
        assert matrix.shape == (3, 3) and np.isfinite(matrix).all() and (np.diag(matrix) > 0).all()
        assert np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])


@given(
    st.lists(st.floats(1, 1e5), min_size=4, max_size=4), st.integers(1, 4000), st.integers(1, 4000)
)
def test_a_camera_fits_its_frames_or_is_refused(path, numbers, height, width):
    fx, fy, u, v = numbers
    text = f"P0: {fx!r} 0 {u!r} 0 0 {fy!r} {v!r} 0 0 0 1 0\n"
    matrix = read(kitti.read_intrinsics, path, text)
    assert np.array_equal(matrix, [[fx, 0, u], [0, fy, v], [0, 0, 1]])  # to the last bit
    fits = (
        min(height, width) >= kitti.MIN_FRAME_SIDE
        and u <= width
        and v <= height
        and all(width / 100 < focal < width * 100 for focal in (fx, fy))
    )
    try:
        kitti.check_camera(path, matrix, path, (height, width))
        assert fits
    except InputError as error:
        assert not fits and str(path) in str(error)


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


@given(
    st.sets(st.integers(0, 300), min_size=3, max_size=300),
    st.integers(1, 6),
    st.sampled_from(["", "a_"]),
)
def test_a_missing_frame_is_named_if_frames_are_counted_one_by_one(path, numbers, digits, prefix):
    ordered = sorted(numbers)
    paths = [path.with_name(f"{prefix}{number:0{digits}d}.png") for number in ordered]
    missing = sorted(set(range(ordered[0], ordered[-1])) - numbers)
    steps = sorted(np.diff(ordered))
    counts = steps[(len(steps) - 1) // 2] == 1
    try:
        kitti.check_numbering(paths)
        assert not (missing and counts)
    except InputError as error:
        assert counts and int(re.search(r"(\d+).png: ", str(error))[1]) == missing[0]


PIXELS = np.random.default_rng(0).integers(0, 35, (20, 30), np.uint8)
PICTURE = cv2.imencode(".png", PIXELS)[1].tobytes()


@given(st.integers(0, len(PICTURE) - 1), st.integers(1, 255))
@example(place=len(PICTURE) - 12, change=1)  # the length of the last chunk
def test_a_changed_byte_of_a_png_is_detected_or_changes_no_pixel(path, place, change):
    data = bytearray(PICTURE)
    data[place] ^= change
    image = read(files.read_gray, path, bytes(data))
    assert image is None or np.array_equal(image, PIXELS)
