"""The video of the odometry."""

import cv2
import numpy as np
import pytest
from street import Street, Stripes

from thesis_repro.odometry import Odometry
from thesis_repro.report import video

BLUE = 178, 114, 0  # colour of the estimate in OpenCV's order


@pytest.fixture
def drive():
    street = Street(4)
    street.times, street.size = 0.1 * np.arange(4), (160, 480)
    return street


def painted(image, color):
    return (image == np.array(color)).all(axis=2)


def test_a_frame_shows_kept_and_discarded_keypoints(drive):
    mask = Stripes(60)[0]
    odometry = Odometry(drive.intrinsics)
    odometry.step(drive.frame(0), mask=mask)
    step = odometry.step(drive.frame(1), 0.4, mask)
    image = video.draw_frame(drive.frame(1), step, mask=mask)
    inside = cv2.erode(mask, np.ones((7, 7))) > 0  # away from the edges, which dots cross
    outside = cv2.dilate(mask, np.ones((7, 7))) == 0
    assert (
        painted(image, video.KEPT)[inside].sum() > 500
        and not painted(image, video.KEPT)[outside].any()
    )
    assert (
        painted(image, video.DISCARDED)[outside].sum() > 500
        and not painted(image, video.DISCARDED)[inside].any()
    )
    assert painted(image, video.OUTLINE).any() and painted(image, video.INLIER).any()


def test_the_video_has_every_frame(drive, tmp_path):
    video.write_video(tmp_path / "drive.webm", drive, masks=Stripes(60))
    file = cv2.VideoCapture(str(tmp_path / "drive.webm"))
    assert int(file.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter_fourcc(*"VP80")
    assert file.get(cv2.CAP_PROP_FPS) == pytest.approx(10, rel=0.01)
    frames = [frame for got, frame in iter(file.read, (False, None))]
    assert [frame.shape for frame in frames] == [(280, 480, 3)] * 4
    for frame, picture in zip(frames, video.pictures(drive, masks=Stripes(60)), strict=True):
        assert np.abs(frame.astype(int) - picture).mean() < 15  # other frames differ by more
    assert np.abs(frames[0].astype(int) - frames[3]).mean() > 5
    assert [file.name for file in tmp_path.iterdir()] == ["drive.webm"]


def test_the_map_shows_the_ground_truth_if_there_is_one(drive):
    last = list(video.pictures(drive))[-1][160:]
    assert painted(last, BLUE).sum() > 20 and painted(last[:90], (0, 0, 0)).sum() > 20
    drive.has_truth, drive.assumed_steps = False, np.array([0.0, 1, 1, 1])
    del drive.poses
    without = list(video.pictures(drive))[-1][160:]
    assert painted(without, BLUE).sum() > 20 and (without != last).any()
