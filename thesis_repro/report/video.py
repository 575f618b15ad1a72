"""Pictures of the odometry at work: keypoints kept and discarded, tracks, the mask's outline, the path so far."""

from fractions import Fraction

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from thesis_repro.files import atomic, progress
from thesis_repro.kitti import FRAME_TIME
from thesis_repro.odometry import THESIS, Odometry, keypoints, scales, start_pose
from thesis_repro.report.style import BASELINE, TRUTH

# blue, green, red, as OpenCV draws; blue and orange can be told apart by most people
KEPT, DISCARDED, OUTLINE = (255, 140, 30), (60, 60, 230), (0, 220, 255)
INLIER, OUTLIER = (120, 220, 0), (0, 140, 255)
MAP_SHARE = 0.75  # height of the map below the frame, in heights of the frame
DPI = 128  # a power of two, so that inches and pixels are the same to the bit


def draw_frame(frame, step, settings=THESIS, mask=None):
    """One frame (height, width) with what the step did on it: (height, width, 3) blue, green, red.

    Points the detector takes, points the mask discards (found by detecting once more without it), the mask's outline,
    and the way each tracked point came: inliers of the essential matrix and outliers.
    """
    image = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
    if mask is not None:
        contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(image, contours, -1, OUTLINE)
        everywhere = keypoints.detect(frame, settings)
        columns, rows = np.rint(everywhere).astype(int).T
        _dots(image, everywhere[mask[rows, columns] == 0], DISCARDED)
    for chosen, color in ((~step.inliers, OUTLIER), (step.inliers, INLIER)):
        lines = np.stack([step.previous[chosen], step.current[chosen]], axis=1)
        cv2.polylines(image, list(np.rint(lines).astype(np.int32)), False, color, 1, cv2.LINE_AA)
    if step.detected:
        _dots(image, step.keypoints, KEPT)
    return image


def _dots(image, points, color):
    for point in np.rint(points).astype(int).tolist():
        cv2.circle(image, point, 2, color, -1, cv2.LINE_AA)


def pictures(sequence, settings=THESIS, masks=None):
    """Run the odometry over a kitti.Sequence and yield one picture a frame, (h, w, 3) blue, green, red.

    Above the frame, below it the path from above beside the true one, growing, and what happened in numbers.
    """
    odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence))
    height, width = sequence.size
    figure = Figure((width / DPI, round(MAP_SHARE * height) / DPI), DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.2, 0.6, 0.75), xlabel="x (m)", ylabel="z (m)")
    axes.set_aspect("equal", adjustable="datalim")
    true, metres, poses = None, scales(sequence), []
    if sequence.has_truth:  # for the errors, the true path starts at frame 1; here both start where the odometry does
        true = sequence.poses[:, :3, 3] + odometry.pose[:3, 3] - sequence.poses[0, :3, 3]
        axes.plot(true[:, 0], true[:, 2], color=TRUTH, label="ground truth")
    (path,) = axes.plot([], [], color=BASELINE, label="estimate")
    figure.legend(loc="lower right")
    words = figure.text(0.7, 0.95, "", va="top")
    for index in progress(range(len(sequence)), "video"):
        frame, mask = sequence.frame(index), None if masks is None else masks[index]
        step = odometry.step(frame, metres[index], mask)
        poses.append(step.pose)
        path.set_data(*np.array(poses)[:, [0, 2], 3].T)
        axes.relim()
        axes.autoscale_view()
        words.set_text(_description(step, true, mask is not None))
        canvas.draw()
        picture = np.vstack([draw_frame(frame, step, settings, mask), np.asarray(canvas.buffer_rgba())[..., 2::-1]])
        yield picture[:len(picture) // 2 * 2, :width // 2 * 2]  # video wants even sizes


def _description(step, true, masked):
    """What happened in a step, in lines that name the colours of the frame."""
    row, lines = step.row(), [f"frame {step.frame}"]
    if true is not None:
        lines.append(f"{np.linalg.norm(step.pose[:3, 3] - true[step.frame]):.2f} m from the truth")
    if step.detected is not None:
        lines.append(f"{step.detected} keypoints (blue)")
    if masked:
        lines.append("discarded by the mask: red")
    if row["tracked"] is not None:
        lines.append(f"{row['inliers']} of {row['tracked']} tracks agree (green)")
    return "\n".join([*lines, *step.flags])


def write_video(path, sequence, settings=THESIS, masks=None):
    """Write `pictures` as a video (H.264, as browsers play it) at the sequence's own pace (its times, seconds)."""
    import av  # here, because loading FFmpeg's libraries is for those alone who want a video

    pace = 1 / np.median(np.diff(sequence.times)) if len(sequence) > 1 else 1 / FRAME_TIME
    with atomic(path) as temporary, av.open(str(temporary), "w", options={"movflags": "+faststart"}) as video:
        stream = video.add_stream("libx264", rate=Fraction(pace).limit_denominator(1000))
        stream.pix_fmt = "yuv420p"  # the one that every browser knows
        for picture in pictures(sequence, settings, masks):
            if not stream.codec_context.is_open:
                stream.height, stream.width = picture.shape[:2]
            video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        video.mux(stream.encode())
