"""What a process of the odometry takes, on a pass too short to take much."""

import pytest

from thesis_repro import InputError, odometry, world
from thesis_repro.bench import memory
from thesis_repro.kitti import Sequence


def test_a_short_drive_is_driven_to_and_fro(tmp_path):
    world.write(tmp_path, sequences=[memory.DRIVE], frames=6, scale=0.2, train_images=1, validation_images=1)
    before = Sequence(tmp_path / "kitti", memory.DRIVE).poses
    memory.to_and_fro(tmp_path / "kitti", 6, 23)
    sequence = Sequence(tmp_path / "kitti", memory.DRIVE)
    assert len(sequence) == len(sequence.poses) == 23
    for index, there in enumerate([0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0, 1]):
        assert (sequence.poses[index] == before[there]).all()
        assert (sequence.frame(index) == sequence.frame(there)).all()
    assert odometry.run(sequence).frames["updated"].sum() > 15


@pytest.mark.slow
def test_memory_grows_by_the_rows_alone():
    found = memory.measure(400, 16, full_frames=3)
    # half of it here; the small frames alone would be 12 MB, were they kept
    assert 2e8 < found["start"] < 1e9 and found["grown"] < 1e7
    with pytest.raises(InputError, match="--frames 5"):
        memory.measure(5, 16)
