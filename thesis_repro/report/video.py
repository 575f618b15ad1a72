"""Pictures of the odometry at work: keypoints kept and discarded, tracks, the mask's outline, the path so far."""

from fractions import Fraction

import cv2
import numpy as np

from thesis_repro.files import atomic, progress
from thesis_repro.kitti import FRAME_TIME
from thesis_repro.odometry import THESIS, Odometry, keypoints, scales, start_pose

# blue, green, red, as OpenCV draws; blue and orange can be told apart by most people
KEPT, DISCARDED, OUTLINE = (255, 140, 30), (60, 60, 230), (0, 220, 255)
INLIER, OUTLIER = (120, 220, 0), (0, 140, 255)
TRUE, ESTIMATED, TEXT, PAPER = (90, 90, 90), (200, 80, 0), (40, 40, 40), (255, 255, 255)
MAP_SHARE = 0.75  # height of the map below the frame, in heights of the frame
MARGIN = 14  # pixels around the map


def draw_frame(frame, step, settings=THESIS, mask=None):
    """One frame (height, width) with what the step did on it: (height, width, 3) blue, green, red.

    Points the detector takes, points the mask discards (found by detecting once more without it), the mask's outline,
    and the way each tracked point came: inliers of the essential matrix and outliers.
    """
    image = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
    if mask is not None:
        contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(image, contours, -1, OUTLINE, 1)
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


def draw_map(size, true, estimated):
    """The path from above, x to the right and z upwards: an image of size (height, width).

    true, estimated: (n, 4, 4) poses, metres; the true path is drawn whole (None: not known), the estimated one as far
    as it goes.
    """
    height, width = size
    image = np.full((height, width, 3), PAPER, np.uint8)
    paths = {} if true is None else {"ground truth": (TRUE, true)}
    paths["estimate"] = ESTIMATED, estimated
    points = np.concatenate([poses[:, [0, 2], 3] for _, poses in paths.values()])
    centre, extent = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0)
    metre = ((np.array([width, height]) - 2 * MARGIN) / np.maximum(extent, max(1, 0.2 * extent.max()))).min()  # pixels
    for row, (name, (color, poses)) in enumerate(paths.items(), 1):
        pixels = np.array([width, height]) / 2 + (poses[:, [0, 2], 3] - centre) * metre * (1, -1)
        cv2.polylines(image, [np.rint(pixels).astype(np.int32)], False, color, 2, cv2.LINE_AA)
        _write(image, name, (MARGIN, 18 * row), color)
    bar = 10.0 ** np.floor(np.log10((width - 2 * MARGIN) / metre / 2))
    cv2.line(image, (MARGIN, height - MARGIN), (round(MARGIN + bar * metre), height - MARGIN), TEXT, 2)
    _write(image, f"{bar:g} m", (MARGIN, height - MARGIN - 6), TEXT)
    return image


def _write(image, text, where, color):
    cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)


def pictures(sequence, settings=THESIS, masks=None):
    """Run the odometry over a kitti.Sequence and yield one picture a frame, (h, w, 3) blue, green, red.

    Above the frame, below it what happened in numbers and the path beside the true one, growing.
    """
    odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence))
    # The true path starts at frame 1 for the errors; here both start where the odometry does.
    true = sequence.poses.copy() if sequence.has_truth else None
    if true is not None:
        true[:, :3, 3] += odometry.pose[:3, 3] - true[0, :3, 3]
    metres, poses = scales(sequence), []
    for index in progress(range(len(sequence)), "video"):
        frame, mask = sequence.frame(index), None if masks is None else masks[index]
        step = odometry.step(frame, metres[index], mask)
        poses.append(step.pose)
        upper = draw_frame(frame, step, settings, mask)
        height, width = frame.shape
        lower = draw_map((int(MAP_SHARE * height), width), true, np.array(poses))
        _describe(lower, step, true, mask is not None)
        yield np.vstack([upper, lower])[:(height + len(lower)) // 2 * 2, :width // 2 * 2]  # video wants even sizes


def _describe(image, step, true, masked):
    """Write onto the map what happened in a step, in the colours of the frame."""
    row = step.row() | {"masked": masked, "error": 0.0}
    if true is not None:
        row["error"] = np.linalg.norm(step.pose[:3, 3] - true[step.frame, :3, 3])
    lines = [("frame {frame}", TEXT, True), ("{error:.2f} m from the truth", TEXT, true is not None),
             ("{detected} keypoints", KEPT, step.detected is not None),
             ("keypoints the mask discards", DISCARDED, masked),
             ("{inliers} of {tracked} tracks agree", (60, 150, 0), row["tracked"] is not None),
             ("{flag}", DISCARDED, row["flag"])]
    for number, (text, color) in enumerate([(text, color) for text, color, shown in lines if shown], 1):
        _write(image, text.format(**row), (image.shape[1] - 275, 20 * number), color)


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
