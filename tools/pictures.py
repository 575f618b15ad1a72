"""Draw the pictures of real streets in figures/kitti_excerpts/pictures.

It takes the frames of the evidence, build/excerpts (`make excerpts`), and writes nothing else. The
model in the package makes the label maps, as for the evidence.
"""

import tempfile
from pathlib import Path

import numpy as np

import thesis_repro as tr
from keypoint_study.report import style
from thesis import real_frames, views
from thesis.run_settings import ROOT
from thesis_repro.data.cityscapes import read_label_map
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry.loop import OPENCV, detect, normalise
from thesis_repro.running import program
from thesis_repro.segmentation import prediction

FOLDER = real_frames.FOLDER / "pictures"
WIDTH = 10  # dilation width of masks, pixels
FEW_SPREAD = 200  # spread keypoints
DIMMED = 2  # times darker beside the mask
STREET, FRAME = "05", 60  # of the first two pictures
FAILS, FAIL_FRAME = "01", 30  # masks fail here
TRACKED, TRACK_FRAME = "drive0005", 20  # a van and a cyclist move ahead
COLORS = style.BASELINE, style.MASKED  # of the two paths
NOTE = (
    "frame of the KITTI Vision Benchmark Suite (Geiger, Lenz, Stiller and Urtasun), {}; "
    "CC BY-NC-SA 3.0, as this picture"
)


def opened(root, name):
    """Open a street of the evidence. Raises InputError if its frames are others."""
    sequence = Sequence(root, name)
    if real_frames.differences(sequence, real_frames.read_manifest().loc[name]):
        raise InputError(f"{sequence.folder}: has other frames than the evidence; make excerpts")
    return sequence


def street_and_masks(sequence, labels):
    """Return two pictures of a frame: from frame to kept keypoints, and spread ones beside them."""
    frame, name = sequence.frame(FRAME), sequence.label_names[FRAME]
    label_map = read_label_map(labels / name)
    mask = tr.keypoint_mask(label_map, frame.shape, WIDTH)
    everywhere, kept, few = detect(frame), detect(frame, mask=mask), tr.spread(FEW_SPREAD)(frame)
    light = np.where(mask > 0, frame, frame // DIMMED)
    title = f"KITTI {sequence.name}, frame {FRAME}: all {len(everywhere)} keypoints"
    colors = style.label_colors(label_map, frame)
    first = {title: (frame, everywhere), "label map by the package's model": colors}
    on_mask = {f"{len(kept)} on the mask, the widened boundaries (light)": (light, kept)}
    whole = {f"the mask: boundaries, widened to {WIDTH} pixels": mask}
    spread = {f"{len(few)} spread over the frame": (frame, few)}
    return {
        "masks": views.pictures(frame, first | whole | on_mask, 2, [label_map]),
        "spread": views.pictures(frame, first | on_mask | spread, 2, [label_map]),
    }


def where_masks_fail(sequence, labels):
    """Return a picture of a frame with the keypoints on its mask, and of the paths beside it."""
    masks = tr.LabelMasks(labels, sequence, WIDTH)
    settings = tr.OdometrySettings(estimator=tr.refined)
    runs = {"all keypoints": None, "keypoints on masks": masks}
    paths = tr.run_many(sequence, {name: (settings, given) for name, given in runs.items()})
    frame, mask = sequence.frame(FAIL_FRAME), masks[FAIL_FRAME]
    kept = detect(frame, mask=mask)
    figure, panels = style.new_figure(2, height=5.6, height_ratios=[1, 1.2])
    text = f"{len(kept)} keypoints on the mask (light) in place of {len(detect(frame))}"
    text = f"KITTI {sequence.name}, frame {FAIL_FRAME}: {text}"
    style.show_image(panels[0], np.where(mask > 0, frame, frame // DIMMED), text)
    panels[0].scatter(*kept.T, **{**style.KEYPOINT, "s": 7})
    looks = {"true path": {"color": style.TRUTH, "linewidth": 4, "alpha": 0.3}}
    looks |= {name: {"color": color} for name, color in zip(runs, COLORS, strict=True)}
    for name, look in looks.items():
        poses = paths[name].poses if name in paths else sequence.poses
        panels[1].plot(*poses[:, [0, 2], 3].T, label=name, **look)
        panels[1].plot(*poses[FAIL_FRAME, [0, 2], 3], "o", color=look["color"], markersize=4)
    text = "the paths from above (refined estimator), over"
    text = f"{text} {len(sequence)} frames; dots: frame {FAIL_FRAME}"
    panels[1].set(xlabel="x (m)", ylabel="z (m)", title=text)
    panels[1].set_aspect("equal", adjustable="datalim")
    panels[1].legend(loc="upper left")
    return {"fails": figure}


def tracks_and_outliers(sequence):
    """Return a picture of the tracks of a step: RANSAC's inliers, and what disagrees with them."""
    before, now = (sequence.frame(TRACK_FRAME + step) for step in (0, 1))
    points = detect(before)
    tracked, found = OPENCV.track(before, now, points)
    old, new = points[found], tracked[found]
    both = (normalise(each, sequence.intrinsics) for each in (new, old))
    _, inliers = OPENCV.find_essential_matrix(*both, tr.THESIS.threshold)
    inliers = inliers.ravel() > 0
    text = f"{inliers.sum()} tracks agree on one motion (green), {(~inliers).sum()} do not (orange)"
    text = f"KITTI raw {sequence.name}, frame {TRACK_FRAME + 1}: {text}"
    return {"tracks": views.tracks(now, old, new, text, inliers)}


@style.applied()
def main():
    """Write the pictures."""
    root = ROOT / "build" / "excerpts"
    streets = {name: opened(root, name) for name in (STREET, FAILS, TRACKED)}
    with tempfile.TemporaryDirectory() as folder:
        labels = {}
        for name in (STREET, FAILS):  # whole streets: the bits of a label map depend on the batch
            labels[name] = Path(folder) / name
            paths = streets[name].frame_paths
            prediction.write_label_maps(prediction.load_shipped(), paths, labels[name])
        drawn = {STREET: street_and_masks(streets[STREET], labels[STREET])}
        drawn[FAILS] = where_masks_fail(streets[FAILS], labels[FAILS])
        drawn[TRACKED] = tracks_and_outliers(streets[TRACKED])
        for name, figures in drawn.items():
            for title, figure in figures.items():
                style.save_figure(figure, FOLDER, title, NOTE.format(name))
    program.summary(f"pictures of real streets: {FOLDER}")


if __name__ == "__main__":
    program.run_main(main)
