"""One style for every figure and table, and the writing of both: SVG or WebP, CSV and Markdown.

Each module of chapters 2 to 4 draws from arrays or a table and returns a matplotlib figure.
"""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from PIL import ExifTags, Image

from thesis_repro.cityscapes import LABELS, colorize
from thesis_repro.files import atomic, write_text

PAGE_WIDTH = 7.2  # inches
matplotlib.rcParams.update({
    "font.size": 9,
    "axes.titlesize": 9, "axes.labelsize": 9,
    "legend.fontsize": 8, "legend.frameon": False,
    "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#dddddd", "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "image.interpolation": "nearest",
    "svg.fonttype": "none",
    "text.parse_math": False,  # names of files and sequences may hold dollars
    "svg.hashsalt": "thesis-repro",  # the same figure gives the same file
    "savefig.dpi": 160,
})
# Okabe and Ito's colours, distinguishable with any colour vision
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, RED, PINK = "#0072b2", "#d55e00", "#cc79a7"
TRUTH, BASELINE, MASKED, REDUCED = BLACK, BLUE, RED, GREEN  # what each colour stands for in all of chapter 4
DIAGRAM = "drawn by the notebook; it does not depend on the data at hand"  # the note where no data is shown
KEYPOINT = {"s": 2.5, "color": "#00e5a0", "linewidths": 0}  # how keypoints are drawn on a frame
EDGE_COLOR = (255, 140, 0)  # red, green, blue of edges drawn on a frame


def line_style(index):
    """Colour and dash of the index-th line of a figure: 28 differ, and neighbours differ without colours as well."""
    colors, dashes = (BLUE, RED, GREEN, ORANGE, PINK, SKY, BLACK), ("-", "--", "-.", ":")
    return {"color": colors[index % len(colors)], "linestyle": dashes[index % len(dashes)]}


def label_colors(label_map, frame):
    """A label map's colours at the frame's size, for looking at (the mask filter has its own enlargement)."""
    rows = np.arange(frame.shape[0]) * label_map.shape[0] // frame.shape[0]
    columns = np.arange(frame.shape[1]) * label_map.shape[1] // frame.shape[1]
    return colorize(label_map[np.ix_(rows, columns)])


def new_figure(rows=1, columns=1, height=3.2, width=PAGE_WIDTH, **options):
    """A figure with the project's style, width and height in inches: (figure, axes)."""
    return plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)


def frame_panels(frame, rows=1, columns=1, width=PAGE_WIDTH):
    """A figure with panels of a frame's shape, titles above them and nothing wasted: (figure, list of axes)."""
    height, long = frame.shape[:2]
    figure, axes = new_figure(rows, columns, rows * (width / columns * height / long + 0.27), width, squeeze=False)
    return figure, list(axes.flat)


def show_image(axes, image, title, **options):
    """An image in its axes without ticks; gray where it has one channel."""
    axes.imshow(image, cmap=options.pop("cmap", "gray"), **options)
    axes.set_title(title)
    axes.set_axis_off()


def small_panels(names, xlabel="", figure=None):
    """A grid of panels, at most four in a row, each with a name as its title and ticks that are few: (figure, panels).

    xlabel: of the lowest of each column. figure: a part of one, to put them in.
    """
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = figure or plt.figure(figsize=(PAGE_WIDTH, rows * 1.65 + 0.6), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for panel in panels[len(names):]:
        panel.remove()
    for panel, name in zip(panels, names, strict=False):
        panel.set_title(name, fontsize=8, pad=3)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    panels = panels[:len(names)]
    for panel in panels[-columns:]:
        panel.set_xlabel(xlabel, fontsize=8)
    return figure, panels


def legend_below(figure, panels, columns):
    """A legend below the figure with each label of its panels once."""
    handles = {label: handle for panel in panels for handle, label in zip(*panel.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def class_legend(figure, *label_maps, also=()):
    """Name the classes of label maps below a figure, which grows by the legend's height; `also`: further handles."""
    names = {}  # Cityscapes gives several labels one colour
    for index in np.unique(np.concatenate([np.unique(label_map) for label_map in label_maps])):
        names.setdefault(LABELS[index].color, []).append(LABELS[index].name)
    handles = [Patch(color=np.array(color) / 255, label=", ".join(labels)) for color, labels in names.items()]
    handles += also
    figure.set_figheight(figure.get_figheight() + 0.1 + 0.16 * -(-len(handles) // 5))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7, markerscale=2)


def ratio_axis(axis, values):
    """Make `axis`, as axes.yaxis, logarithmic, just wider than the positive ones of the values, with a few round ticks.

    Equal values get room around them.
    """
    values = np.asarray(values, float)
    values = values[np.isfinite(values) & (values > 0)]
    low, high = (values.min(), values.max()) if len(values) else (1, 1)
    margin = max((high / low) ** 0.05, 1.1 if high < 1.1 * low else 1)
    low, high = low / margin, high * margin
    # within a factor of five, ticks at equal differences are rounder than ticks at equal ratios
    locator = MaxNLocator(5) if high < 5 * low else LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,), numticks=6)
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    axis.set_major_locator(locator)
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def save_figure(figure, folder, name, note):
    """Write folder/name with the data note at the foot: .webp where the figure shows pictures, else .svg.

    Either is what a browser shows best at the least size; the note stands in the file's text as well.
    """
    folder = Path(folder)
    # A tight box lets legends at the figure's edge slip down onto the note, so they are pinned where the layout put
    # them.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for legend in figure.legends:
        box = legend.get_window_extent().transformed(figure.transFigure.inverted())
        legend.borderaxespad = 0
        legend.set_loc("lower left")
        legend.set_bbox_to_anchor((box.x0, box.y0), transform=figure.transFigure)
    figure.text(0.5, -0.08 / figure.get_figheight(), note, fontsize=6, color="#777777", ha="center", va="top")
    if any(axes.images for axes in figure.axes):
        ending, other, note_in_file = ".webp", ".svg", Image.Exif()
        note_in_file[ExifTags.Base.ImageDescription] = note
        options = {"pil_kwargs": {"quality": 90, "exif": note_in_file}}
    else:
        ending, other = ".svg", ".webp"
        options = {"metadata": {"Date": None, "Creator": None, "Description": note}}
    with atomic(folder / f"{name}{ending}") as temporary:
        figure.savefig(temporary, bbox_inches="tight", pad_inches=0.04, **options)
    (folder / f"{name}{other}").unlink(missing_ok=True)  # of a run in which it was the other kind


def save_table(table, folder, name, note):
    """Write folder/name.csv and .md with the data note under the Markdown table."""
    folder = Path(folder)
    write_text(folder / f"{name}.csv", table.to_csv(index=False, lineterminator="\n"))
    write_text(folder / f"{name}.md", f"{markdown(table)}\n{note}\n")


def save_all(figures, tables, folder, note):
    """Write figures and tables that have rows, {name: ...} of each; returns (kind, name) of what was written."""
    tables = {name: table for name, table in tables.items() if len(table)}
    for name, figure in figures.items():
        save_figure(figure, folder, name, note)
        plt.close(figure)
    for name, table in tables.items():
        save_table(table, folder, name, note)
    return [*(("figure", name) for name in figures), *(("table", name) for name in tables)]


def markdown(table):
    """A pandas table as a Markdown one; numbers are aligned to the right, missing values are empty."""
    numeric = [pd.api.types.is_numeric_dtype(table[column]) for column in table]
    rows = [list(table.columns), ["---:" if right else ":---" for right in numeric]]
    rows += [["" if pd.isna(value) else f"{value:g}" if isinstance(value, float) else str(value) for value in row]
             for row in table.itertuples(index=False)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
