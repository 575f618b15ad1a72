"""Figures: what they count and measure is what the data says, and nothing overlaps the note at the foot."""

import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from thesis_repro import cityscapes, kitti
from thesis_repro.cityscapes import ID, LABELS
from thesis_repro.report import background, methods, style
from thesis_repro.study import flicker


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def texts(figure):
    # without the labels of ticks, which only exist once drawn
    return [item.get_text() for item in figure.findobj(matplotlib.text.Text) if item.get_text()]


def textured(shift=0, size=(120, 240)):
    noise = np.random.default_rng(0).integers(0, 256, (size[0] // 4, size[1] // 2), np.uint8)
    wide = noise.repeat(4, 0).repeat(4, 1)
    return wide[:, 40 - shift:40 - shift + size[1]].copy()


def test_iou_figure_states_the_areas_and_their_ratio():
    label_map, prediction = (np.full((20, 20), ID["road"], np.uint8) for _ in range(2))
    label_map[:10], prediction[:15] = ID["car"], ID["car"]  # 200 and 300 pixels, one inside the other
    figure = methods.figure_3_03(np.zeros((20, 20), np.uint8), label_map, prediction, LABELS[ID["car"]])
    assert "IoU = 200 / 300 = 0.67" in texts(figure)
    assert {"label map: 200 pixels", "prediction: 300 pixels"} <= set(texts(figure))


def test_focal_loss_follows_equation_3_7():
    lines = {line.get_label(): line.get_xydata() for line in methods.figure_3_04().axes[0].lines}
    assert len(lines) == 5
    p, loss = lines["γ = 2"].T
    assert loss == pytest.approx(-((1 - p) ** 2) * np.log(p))
    assert lines["γ = 0 (cross-entropy)"][:, 1] == pytest.approx(-np.log(p))


def test_pixel_counts_are_those_of_the_classes_present():
    counts = np.zeros(35, int)
    counts[[ID["road"], ID["car"], ID["sky"]]] = 50, 1000, 7
    axes = methods.figure_3_05(counts, 4).axes[0]
    assert [bar.get_height() for bar in axes.patches] == [1000, 50, 7]
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["car", "road", "sky"]


def test_max_pooling_keeps_the_largest_of_each_block():
    numbers = [int(text) for text in texts(background.figure_2_04()) if text.isdigit()]
    assert len(numbers) == 20
    before, after = np.reshape(numbers[:16], (4, 4)), np.reshape(numbers[16:], (2, 2))
    assert (after == [[before[:2, :2].max(), before[:2, 2:].max()], [before[2:, :2].max(), before[2:, 2:].max()]]).all()


def test_softmax_scores_add_up_to_one():
    shown = texts(background.figure_2_05())
    scores = [float(text.split(": ")[1]) for text in shown if text.startswith("class")]
    assert len(scores) == 3 and sum(scores) == pytest.approx(1, abs=0.011)


def test_unet_figure_is_read_from_the_model():
    from thesis_repro.segmentation.unet import build_unet

    small = background.figure_2_07(build_unet((32, 32, 1), 35, base_filters=2))
    shown = texts(small)
    assert {"32x32", "2x2", "35"} <= set(shown) and shown.count("64") == 0
    arrows = [patch for patch in small.axes[0].patches if isinstance(patch, matplotlib.patches.FancyArrowPatch)]
    assert len(arrows) == 4  # one skip connection a level
    assert "64" in texts(background.figure_2_07(build_unet((32, 32, 1), 35, base_filters=4)))


def test_relative_motions_are_measured_between_the_poses():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 2, 3] = 2.0
    poses[2, :3, 3] = 1.5, 0, 2.0
    turn = np.radians(30)
    poses[2, :3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    shown = texts(background.figure_2_08(poses, "title"))
    assert "$T_{1,0}$\n2.0 m, 0.0°" in shown and "$T_{2,1}$\n1.5 m, 30.0°" in shown


def test_drift_is_drawn_as_large_as_it_is():
    true = np.zeros((20, 3))
    true[:, 2] = np.arange(20.0)
    figure = background.figure_2_10(true + [0.4, 0, 0], true, "title")
    path = next(line for line in figure.axes[0].lines if line.get_label() == "estimated path")
    assert np.allclose(path.get_xdata(), 0.4) and np.allclose(figure.axes[1].lines[0].get_ydata(), 0.4)
    plt.close(figure)


def test_a_pure_shift_is_found_again():
    first, second = textured(), textured(5)
    in_first, in_second, lost, new = flicker.found_again(first, second)
    assert len(in_first) > 3 * len(lost)
    assert np.median(in_second - in_first, axis=0) == pytest.approx((5, 0), abs=0.1)
    blank = np.zeros_like(first)
    in_first, _, lost, new = flicker.found_again(first, blank)
    assert len(in_first) == len(new) == 0 and len(lost)
    assert all(len(points) == 0 for points in flicker.found_again(blank, blank))
    left = np.zeros_like(first)
    left[:, :100] = 255
    in_first, in_second, lost, new = flicker.found_again(first, second, left, left)
    assert max(in_first[:, 0].max(), lost[:, 0].max(), new[:, 0].max()) < 100 and len(in_first) > len(lost)
    figure = background.figure_2_11(first, second, *_grouped(first, second), ("first", "second"))
    assert any(text.startswith("first: ") and "found again" in text for text in texts(figure))


def _grouped(first, second):
    in_first, in_second, lost, new = flicker.found_again(first, second)
    return (in_first, in_second), lost, new


def test_keypoints_jump_with_the_boundary_and_stay_without():
    label_map = np.full((120, 240), ID["road"], np.uint8)
    label_map[40:75, 100:130] = ID["car"]
    moved = np.roll(label_map, 14, axis=1)
    frame = textured()
    still, jumping = (flicker.follow([frame, frame], [label_map, other], 5) for other in (label_map, moved))
    assert still[0].expected is None and len(still[0].keypoints) >= flicker.FEW
    assert len(still[1].expected) == len(still[0].keypoints) and still[1].jumped == 0
    assert jumping[1].jumped > len(jumping[1].expected) / 3
    assert still[0].crop.shape == still[0].edges.shape
    # no object at all: the middle of the frame
    empty = flicker.follow([frame, frame], [np.zeros_like(frame)] * 2, 5, first=7)
    assert [view.frame for view in empty] == [7, 8] and not len(empty[1].expected)
    methods.figure_4_08(empty, "title").draw_without_rendering()


def test_matches_of_a_frame_without_corners_are_none():
    blank = np.full((60, 120), 128, np.uint8)
    assert any("0 best of 0" in text for text in texts(background.figure_2_09(blank, blank, "title")))


def test_the_same_figure_gives_the_same_files_with_its_note(tmp_path):
    blank = np.full((60, 120), 128, np.uint8)
    for folder in (tmp_path / "one", tmp_path / "two"):
        style.save_figure(background.figure_2_03(), folder, "plot", "a note")
        style.save_figure(background.figure_2_09(blank, blank, "title"), folder, "picture", "a note")
        assert sorted(path.name for path in folder.iterdir()) == ["picture.webp", "plot.svg"]
    for name in ("plot.svg", "picture.webp"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
        assert b"a note" in (tmp_path / "one" / name).read_bytes()
    style.save_figure(background.figure_2_03(), tmp_path / "one", "picture", "a note")  # has become a plot
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == ["picture.svg", "plot.svg"]


def test_figures_of_frames_on_the_world(small_world, tmp_path):
    """Titles stay inside the page and above their panels, whatever the frames' shape."""
    sequence = kitti.Sequence(small_world / "kitti", "00")
    frame = sequence.frame(0)
    label_map = cityscapes.read_label_map(sequence.folder / "labels_0" / sequence.frame_paths[0].name)
    points = np.array([[10.0, 20.0], [30.0, 20.0]])
    for figure in (
            background.figure_2_12(frame, points, label_map, points[:1], ("frame", "its label map")),
            background.figure_2_09(frame, sequence.frame(2), "sequence 00"),
            methods.figure_3_06(frame, label_map, label_map, label_map, 10),
            methods.figure_4_03(frame, label_map, "frame"),
            methods.figure_4_05(frame, points, label_map, label_map, points, 10, "frame")):
        figure.draw_without_rendering()
        boxes = [axes.get_tightbbox() for axes in figure.axes]
        assert all(not one.overlaps(other) for index, one in enumerate(boxes) for other in boxes[index + 1:])
        assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in boxes)
