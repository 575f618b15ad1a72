"""Videos of the odometry: keypoints, tracks, the outline of the mask and the path so far."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import (
    THESIS,
    Odometry,
    OdometrySettings,
    Step,
    keypoints,
    scales,
    start_pose,
)
from thesis_repro.odometry.runs import Masks
from thesis_repro.report.style import BASELINE, TRUTH, applied
from thesis_repro.running import messages
from thesis_repro.running.files import atomic, progress

# colours as blue, green, red
KEPT, DISCARDED, OUTLINE = (255, 140, 30), (60, 60, 230), (0, 220, 255)
INLIER, OUTLIER = (120, 220, 0), (0, 140, 255)
MAP_SHARE = 0.75  # height of the map divided by the height of the frame
DPI = 128  # a power of two, so that pixels convert to inches and back without rounding


def draw_frame(
    frame: np.ndarray,
    step: Step,
    settings: OdometrySettings = THESIS,
    mask: np.ndarray | None = None,
) -> np.ndarray:
    """Draw a step of the odometry on its frame.

    frame: (height, width). Returns (height, width, 3), blue, green, red. The image shows detected
    keypoints, keypoints that the mask discards (from a second detection without the mask), the
    mask's outline, and the tracks: inliers and outliers of the essential matrix.
    """
    image = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
    if mask is not None:
        contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(image, contours, -1, OUTLINE)
        all_keypoints = keypoints.detect(frame, settings)
        columns, rows = np.rint(all_keypoints).astype(int).T
        _dots(image, all_keypoints[mask[rows, columns] == 0], DISCARDED)
    for selected, color in ((~step.inliers, OUTLIER), (step.inliers, INLIER)):
        lines = np.stack([step.previous[selected], step.current[selected]], axis=1)
        cv2.polylines(image, list(np.rint(lines).astype(np.int32)), False, color, 1, cv2.LINE_AA)
    if step.detected:
        _dots(image, step.keypoints, KEPT)
    return image


def _dots(image: np.ndarray, points: np.ndarray, color: tuple[int, int, int]) -> None:
    for point in np.rint(points).astype(int).tolist():
        cv2.circle(image, point, 2, color, -1, cv2.LINE_AA)


def pictures(
    sequence: Sequence, settings: OdometrySettings = THESIS, masks: Masks | None = None
) -> Iterator[np.ndarray]:
    """Run the odometry over a kitti.Sequence and yield one picture for each frame.

    A picture is (h, w, 3), blue, green, red. Its height and width are even. The upper part is the
    frame. The lower part shows the path so far, the ground truth and numbers of the step.
    """
    odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence))
    height, width = sequence.size
    figure = Figure((width / DPI, round(MAP_SHARE * height) / DPI), DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.2, 0.6, 0.75), xlabel="x (m)", ylabel="z (m)")
    axes.set_aspect("equal", adjustable="datalim")
    metres = scales(sequence)
    # both paths start at the same point here; for the RMSE they meet at frame 1
    if sequence.has_truth:
        true = sequence.poses[:, :3, 3] + odometry.pose[:3, 3] - sequence.poses[0, :3, 3]
        axes.plot(true[:, 0], true[:, 2], color=TRUTH, label="ground truth")
    (path,) = axes.plot([], [], color=BASELINE, label="estimate")
    figure.legend(loc="lower right")
    description = figure.text(0.7, 0.95, "", va="top")
    positions = []
    for index in progress(range(len(sequence)), "video"):
        frame = sequence.frame(index)
        mask = None
        if masks is not None:
            mask = masks[index]
        step = odometry.step(frame, metres[index], mask)
        positions.append(step.pose[[0, 2], 3])
        path.set_data(*np.transpose(positions))
        axes.relim()
        axes.autoscale_view()
        description.set_text(_describe(step))
        canvas.draw()
        drawn = draw_frame(frame, step, settings, mask)
        below = np.asarray(canvas.buffer_rgba())[..., 2::-1]
        picture = np.vstack([drawn, below])
        # colours at half the size need even sizes
        yield picture[: len(picture) // 2 * 2, : width // 2 * 2]


def _describe(step: Step) -> str:
    """Describe a step in lines of text that name the colours in the frame."""
    lines = [
        f"frame {step.frame}",
        f"{len(step.keypoints)} keypoints (blue)",
        "discarded by a mask: red",
        f"{step.inliers.sum()} of {len(step.inliers)} tracks agree (green)",
    ]
    return "\n".join([*lines, *step.flags])


@applied()
def write_video(
    path: Path, sequence: Sequence, settings: OdometrySettings = THESIS, masks: Masks | None = None
) -> None:
    """Write `pictures` as a WebM video (VP8) with the frame rate of the sequence's times.

    Every browser plays VP8. OpenCV takes four times as long for VP9. Raises InputError if the video
    was not written whole.
    """
    frame_time = np.median(np.diff(sequence.times))
    writer = cv2.VideoWriter()
    with atomic(path) as temporary:
        for picture in pictures(sequence, settings, masks):
            if not writer.isOpened():
                with messages.quiet():  # OpenCV looks for the codec's tag, which WebM does not use
                    vp8, size = cv2.VideoWriter_fourcc(*"VP80"), picture.shape[1::-1]
                    writer.open(str(temporary), cv2.CAP_FFMPEG, vp8, 1 / frame_time, size)
            writer.write(picture)
        writer.release()
        # the writer reports no errors, such as a full disk
        video = cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG)
        written = 0
        while video.grab():
            written += 1
        if written != len(sequence):
            raise InputError(f"{path}: the video was not written whole; make room on its disk")
