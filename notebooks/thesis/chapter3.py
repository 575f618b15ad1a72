"""Figures of chapter 3 and of masks, and what notebook 06 measures of masks."""

from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

import thesis_repro as tr
from keypoint_study.report import style
from keypoint_study.report.style import BLUE, ORANGE, RED, SKY
from thesis import views
from thesis_repro import masks
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.cityscapes import read_label_map
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import dilate
from thesis_repro.odometry import metrics
from thesis_repro.odometry.loop import detect


def figure_3_02(
    as_image: dict[str, np.ndarray], as_map: dict[str, np.ndarray], ids: np.ndarray, outside: int
) -> Figure:
    """Figure 3.2: a label map transformed as an image (above) and as a label map (below).

    as_image, as_map: {title: (h, w) ids}. ids: those of the label map. outside: the id of pixels
    from outside the image in `as_map`; in `as_image` it is 0. Ids that are not there are white.
    """
    figure, axes = style.new_figure(2, 4, height=3.8)
    label_maps = []
    for column, title in enumerate(as_image):
        invented = ~np.isin(as_image[title], [*ids, 0])
        colors = cityscapes.colorize(as_image[title])
        colors[invented] = 255
        style.show_image(
            axes[0, column], colors, f"{title}\n{100 * invented.mean():.1f} % of no class here"
        )
        style.show_image(axes[1, column], cityscapes.colorize(as_map[title]), "")
        label_maps.append(as_map[title][as_map[title] != outside])
    texts = "transformed as an image\n(the appendix)", "as a label map\n(for training)"
    for panel, text in zip(axes[:, 0], texts, strict=True):
        panel.text(
            -0.12, 0.5, text, transform=panel.transAxes, rotation=90, ha="center", va="center"
        )
    white = Patch(facecolor="white", edgecolor="black", label="id of no class here")
    black = Patch(color="black", label="outside the image")
    style.class_legend(figure, *label_maps, also=[white, black])
    return figure


def figure_3_03(
    image: np.ndarray, label_map: np.ndarray, prediction: np.ndarray, label: cityscapes.Label
) -> Figure:
    """Figure 3.3: intersection and union of a prediction and its label map for one class.

    Equation 3.1. image: (h, w) gray or (h, w, 3) RGB.
    """
    true, predicted = label_map == label.id, prediction == label.id
    both = true & predicted
    intersection, union = both.sum(), (true | predicted).sum()
    panels = {
        f"label map: {true.sum():,} pixels": {ORANGE: true},
        f"prediction: {predicted.sum():,} pixels": {SKY: predicted},
        f"IoU = {intersection:,} / {union:,} = {intersection / max(union, 1):.2f}": {
            ORANGE: true,
            SKY: predicted,
            BLUE: both,
        },
    }
    dimmed = np.dstack([image] * 3)[..., :3] // 3 + 150
    figure, axes = style.new_figure(1, 3, height=2.9)
    for panel, (title, areas) in zip(axes, panels.items(), strict=True):
        picture = dimmed.copy()
        for color, area in areas.items():
            picture[area] = 255 * np.array(to_rgb(color))
        style.show_image(panel, picture, title)
    handles = [
        Patch(color=ORANGE, label="label map"),
        Patch(color=SKY, label="prediction"),
        Patch(color=BLUE, label="both: the intersection"),
    ]
    figure.legend(
        handles=handles,
        title=f"class {label.name}; the three colours together are the union",
        title_fontsize=8,
        loc="outside lower center",
        ncols=3,
    )
    return figure


def figure_3_05(counts: np.ndarray, title: str) -> Figure:
    """Figure 3.5: the pixels of each label id, counts (ids,), on a logarithmic scale."""
    present = sorted(
        (label for label in cityscapes.LABELS[: len(counts)] if counts[label.id]),
        key=lambda label: -counts[label.id],
    )
    pixels = [counts[label.id] for label in present]
    figure, axes = style.new_figure(height=3.4)
    # points, because the height of a bar means nothing on a logarithmic axis
    axes.scatter(
        [label.name for label in present],
        pixels,
        s=60,
        color=[np.array(label.color) / 255 for label in present],
        edgecolors="#555555",
        linewidths=0.5,
    )
    for position, count in enumerate(pixels):
        axes.annotate(
            f"{100 * count / sum(pixels):.2f} %",
            (position, count),
            (0, 6),
            textcoords="offset points",
            ha="center",
            fontsize=6.5,
        )
    style.ratio_axis(axes.yaxis, [min(pixels) / 2, 2 * max(pixels)])
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.set(ylabel="pixels", xlabel="category", title=title)
    axes.tick_params(axis="x", labelrotation=45, labelsize=8)
    for name in axes.get_xticklabels():
        name.set(ha="right", rotation_mode="anchor")
    axes.margins(x=0.05)
    axes.grid(axis="x", visible=False)
    return figure


def figure_3_06(
    frame: np.ndarray,
    label_map: np.ndarray,
    edge_image: np.ndarray,
    mask: np.ndarray,
    dilation_width: int,
) -> Figure:
    """Figure 3.6: a frame, its predicted label map, its edges and the edges dilated.

    Below, the window with most edges is enlarged. It is marked in the frame and in the label map.
    """
    height, width = np.array(frame.shape) // 5
    windows = [
        np.s_[top : top + height, left : left + width]
        for top in range(0, 4 * height, height // 2)
        for left in range(0, 4 * width, width // 2)
    ]
    window = max(windows, key=lambda window: edge_image[window].sum())
    pictures = {
        "frame": frame,
        "predicted label map": style.label_colors(label_map, frame),
        "edges of the label map": edge_image,
        f"edges dilated by {dilation_width}x{dilation_width}": mask,
        "edges in the marked part": edge_image[window],
        "dilated edges in the marked part": mask[window],
    }
    figure = views.pictures(frame, pictures, columns=2, label_maps=[label_map])
    # lines of one pixel would drop out where the picture is reduced to the nearest pixels
    figure.axes[2].images[0].set_interpolation("antialiased")
    for panel in figure.axes[:2]:
        corner = window[1].start, window[0].start
        panel.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=RED))
    return figure


def figure_masks(
    frame: np.ndarray,
    masks: dict[str, np.ndarray],
    keypoints: dict[str, np.ndarray],
    true_edges: np.ndarray | None = None,
) -> Figure:
    """Figure "masks": one frame with several masks.

    The kept area is light; true boundaries are drawn on it.
    masks: {title: (h, w)}. keypoints: {title: (n, 2)}. true_edges: (h, w), 255 on boundaries, or
    None if unknown.
    """
    edges = np.zeros_like(frame) if true_edges is None else dilate(true_edges, 3)
    pictures = {}
    for title, mask in masks.items():
        shaded = np.where(mask > 0, frame // 2 + 127, frame // 3)
        pictures[title] = views.with_edges(shaded, edges), keypoints[title]
    figure = views.pictures(frame, pictures, columns=2)
    marks = [
        Patch(facecolor="#bbbbbb", edgecolor="black", label="kept by the mask"),
        Line2D(
            [], [], marker="o", color=style.KEYPOINT["color"], ls="none", label="keypoints on it"
        ),
    ]
    if true_edges is not None:
        color = tuple(np.array(style.EDGE_COLOR) / 255)
        marks.append(Line2D([], [], color=color, label="true boundaries of classes"))
    figure.legend(handles=marks, loc="outside lower center", ncols=3)
    return figure


# What notebook 06 measures


def row_of_run(result: Any, of_frames: Any, drive: Sequence) -> dict[str, float]:
    """Return a row of a table: the masks of a run over a drive, its keypoints and errors.

    of_frames: a mask a frame, or None for all keypoints.
    """
    covered = 1.0
    if of_frames is not None:
        some = range(0, len(drive), 5)
        covered = float(np.mean([masks.coverage(of_frames[number]) for number in some]))
    return {
        "coverage (%)": 100 * covered,
        "keypoints": result.frames["detected"].mean(),
        "aligned ATE (m)": metrics.ate(result.poses, drive.poses, "se3"),
        "rotation error (°/frame)": metrics.step_errors(result.poses, drive.poses)["rotation"],
    }


def table_of_runs(drive: Sequence, runs: dict[str, tuple[Any, Any]]) -> pd.DataFrame:
    """Run a drive with each (settings, masks), and return a row for each run."""
    results = tr.run_many(drive, runs)
    rows = {text: row_of_run(result, runs[text][1], drive) for text, result in results.items()}
    return pd.DataFrame(rows).T


def counts(drive: Sequence, labels: Path, numbers: Rows[int], *how: Any) -> dict[str, float]:
    """Return what masks have on average over frames: coverage, keypoints, true boundaries.

    labels: folder of their label maps. how: width and settings, as in `keypoint_mask`. The last two
    numbers need true label maps.
    """
    exact, rows = drive.folder / kitti.TRUE_LABELS, []
    for number in numbers:
        name = drive.label_names[number]
        made = tr.keypoint_mask(read_label_map(labels / name), drive.size, *how)
        found = detect(drive.frame(number), tr.THESIS, made)
        count = {"coverage (%)": 100 * masks.coverage(made), "keypoints": len(found)}
        if exact.is_dir():
            true = read_label_map(exact / name)
            perfect = tr.keypoint_mask(true, drive.size, *how)
            count["true boundaries kept (%)"] = 100 * masks.boundaries_found(made, true)
            count["of true label maps (%)"] = 100 * masks.boundaries_found(perfect, true)
        rows.append(count)
    return dict(pd.DataFrame(rows).mean())


def overview(
    frame: np.ndarray, label_map: np.ndarray, source: str, street: str, width: int
) -> plt.Figure:
    """Draw the README's picture: all keypoints, a label map, those on its mask, 200 spread ones.

    source: whose label map it is. street: "real" or "rendered". width: of the dilation, pixels.
    """
    mask = tr.keypoint_mask(label_map, frame.shape, width)
    light = np.where(mask > 0, frame, frame // 3)
    every, on_it = detect(frame, tr.THESIS), detect(frame, tr.THESIS, mask)
    few = tr.spread(200)(frame)
    shown: dict[str, Any] = {f"{street} street: all {len(every)} keypoints": (frame, every)}
    shown[source] = style.label_colors(label_map, frame)
    shown[f"{len(on_it)} on the mask, the widened boundaries (light)"] = light, on_it
    shown[f"{len(few)} spread over the frame"] = frame, few
    return views.pictures(frame, shown, columns=2, label_maps=[label_map])
