"""Figures of chapters 2 to 4 show the numbers of the data; their files have repeatable bytes."""

import re
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.text import Text

from keypoint_study.report import paths, style
from thesis import chapter2, chapter3, chapter4, views
from thesis_repro.data.cityscapes import ID, LABELS


def texts(figure):
    return [item.get_text() for item in figure.findobj(Text) if item.get_text()]


def textured(shift=0, size=(120, 400)):
    noise = np.random.default_rng(0).integers(0, 256, (size[0] // 4, size[1] // 2), np.uint8)
    wide = noise.repeat(4, 0).repeat(4, 1)
    return wide[:, 40 - shift : 40 - shift + size[1]].copy()


def turning():
    """Five poses, the last two after a turn of 30 degrees to the right."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = 0, 2, 4, 5, 6
    poses[3:, 0, 3] = 1, 2
    turn = np.radians(30)
    poses[3:, :3, :3] = [
        [np.cos(turn), 0, np.sin(turn)],
        [0, 1, 0],
        [-np.sin(turn), 0, np.cos(turn)],
    ]
    return poses


def convolution(channels=1):
    random = np.random.default_rng(0)
    patch, kernel = (
        random.integers(0, 256, (12, 12, channels)),
        random.normal(0, 0.2, (3, 3, channels)),
    )
    response = np.random.default_rng(1).normal(0, 50, (12, 12))
    response[6, 4] = 1.25 + (patch[5:8, 3:6] * kernel).sum()
    return patch, kernel, 1.25, response, np.maximum(response, 0), (6, 4)


FRAME, LATER = textured(), textured(5)
BLANK = np.zeros_like(FRAME)
MASK = BLANK.copy()
MASK[40:75, 100:130] = 255  # on the car
ODD = {
    "a kernel of three channels": lambda: chapter2.figure_2_02(*convolution(3)),
    "no keypoints": lambda: chapter4.figure_4_08(
        views.follow_window([FRAME] * 2, [BLANK] * 2, 5), "00"
    ),
    "no truth": lambda: paths.figure_of_paths({"$all$": turning()}, None, "sequence 11"),
}


@pytest.mark.parametrize("name", ODD)
def test_figures_of_odd_data_can_be_drawn(name):
    ODD[name]().draw_without_rendering()


def test_numbers_of_the_convolution_sum_to_its_response():
    figure = chapter2.figure_2_02(*convolution())
    field, weights, products = (
        [float(text.get_text()) for text in axes.texts] for axes in figure.axes[3:6]
    )
    assert products == pytest.approx(np.multiply(field, weights), abs=0.02)
    assert 1.25 + sum(products) == pytest.approx(convolution()[3][6, 4], abs=0.05)
    assert f"{convolution()[3][6, 4]:.1f}" in figure.get_supxlabel()


def test_the_iou_figure_shows_areas_and_their_ratio():
    label_map, prediction = (np.full((20, 20), ID["road"], np.uint8) for _ in range(2))
    # 200 and 300 pixels, one inside the other
    label_map[:10], prediction[:15] = ID["car"], ID["car"]
    shown = " ".join(
        texts(chapter3.figure_3_03(label_map, label_map, prediction, LABELS[ID["car"]]))
    )
    assert all(number in shown for number in ("200 / 300", "0.67", "200 pixels", "300 pixels"))


def test_matched_points_of_a_shifted_frame():
    in_first, in_second, lost, _ = views.found_again(FRAME, LATER)
    assert len(in_first) > 3 * len(lost)
    assert np.median(in_second - in_first, axis=0) == pytest.approx((5, 0), abs=0.1)


def test_the_procedure_shows_keypoints_on_the_mask_and_those_of_all_off_it():
    mask = np.zeros_like(FRAME)
    mask[:, :200] = 255
    panels = chapter4.figure_4_05(FRAME, MASK // 255, mask, "title").axes
    every, kept, dropped = (panels[n].collections[0].get_offsets() for n in (1, 4, 5))
    assert kept[:, 0].max() < 200 <= dropped[:, 0].min()
    assert len(dropped) == (every[:, 0] >= 200).sum() > 100
    numbers = [str(len(points)) for points in (every, kept, dropped)]
    assert all(number in panels[n].get_title() for number, n in zip(numbers, (1, 4, 5)))


def test_keypoints_jump_with_a_moving_boundary_alone():
    frame = textured(size=(120, 240))
    car = np.where(MASK[:, :240] > 0, ID["car"], ID["road"]).astype(np.uint8)
    still, jumping = (
        views.follow_window([frame, frame], [car, later], 5, first=7)
        for later in (car, np.roll(car, 14, 1))
    )
    assert [view.frame for view in still] == [7, 8] and still[0].expected is None
    assert len(still[1].expected) == len(still[0].keypoints) > 0 and still[1].jumped == 0
    assert (
        jumping[1].jumped > len(jumping[1].expected) / 3
        and still[0].crop.shape == still[0].edges.shape
    )


def test_saved_figures_have_repeatable_bytes_and_a_note(tmp_path):
    for folder in (tmp_path / "first", tmp_path / "second"):
        style.save_figure(chapter2.figure_2_08(turning(), "title"), folder, "plot", "a note")
        style.save_figure(chapter2.figure_2_09(FRAME, LATER, "title"), folder, "picture", "a note")
    for name in ("plot.svg", "picture.webp"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
        assert b"a note" in (tmp_path / "first" / name).read_bytes()


@pytest.mark.parametrize(
    "low, high",
    [
        (1, 1),
        (1.01, 1.02),
        (0.97, 1.3),
        (0.3, 4),
        (2, 90),
        (1, 130),
        (1e-3, 1e5),
        (300, 2000),
        (1.5, 0.7),
        (np.nan, 1.2),
    ],
)
def test_a_ratio_axis_has_a_few_round_ticks_within_it(low, high):
    axis = plt.figure().add_subplot().yaxis
    style.ratio_axis(axis, [low, high])
    bottom, top = axis.get_view_interval()
    ticks = [tick for tick in axis.get_ticklocs() if bottom <= tick <= top]
    assert axis.get_scale() == "log" and 2 <= len(ticks) <= 8
    assert all(bottom <= value <= top for value in (low, high) if 0 < value < np.inf)
    assert not len(axis.get_ticklocs(minor=True))
    assert all(
        float(axis.get_major_formatter()(tick)) == pytest.approx(tick, rel=1e-5) for tick in ticks
    )


def test_the_last_bits_of_coordinates_do_not_change_a_file(tmp_path):
    """Other vector instructions add numbers in another order."""
    for name, nudge in (("a", 0.0), ("b", 1e-13)):
        figure = plt.figure()
        axes = figure.add_axes((0.1 + nudge, 0.1, 0.5 - nudge, 0.5))
        axes.plot([0, 1 / 3, 1 + nudge], [nudge, 2 / 3, 1], "o-", label="0.1234567 -0 #a123456789b")
        axes.fill_between([0, 1], [0, 1 - nudge], hatch="/")
        axes.legend()
        style.write_figure(figure, tmp_path / f"{name}.svg")
        plt.close(figure)
    svg = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert svg == (tmp_path / "b.svg").read_text(encoding="utf-8")
    assert "0.1234567 -0 #a123456789b" in svg
    links = set(re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", svg))
    assert links and links <= set(re.findall(r'id="([^"]+)"', svg))
    assert ElementTree.fromstring(svg).get("width").endswith("pt")  # still well-formed
