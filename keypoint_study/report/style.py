"""The style of all figures and tables, and functions that write them.

Figures are written as SVG or WebP, tables as CSV and Markdown.
"""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import Locator, LogLocator, MaxNLocator, NullLocator
from PIL import ExifTags, Image

from keypoint_study.report.texts import in_markdown
from thesis_repro.data.cityscapes import LABELS, colorize
from thesis_repro.running.files import atomic, write_text

PAGE_WIDTH, COLUMN_WIDTH = 7.2, 3.5  # inches, of figures across a page and in one column of a paper
NOTE_LETTERS = 22  # of a note, in an inch
LEGEND_LETTERS = 16  # of a line of a class's names in one of three columns of a narrow figure
# Okabe and Ito's colours, distinguishable with any colour vision
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, RED, PINK = "#0072b2", "#d55e00", "#cc79a7"
# four of Paul Tol's, for figures of more lines
INDIGO, OLIVE, WINE, GRAY = "#332288", "#999933", "#882255", "#888888"
LINE_COLORS = BLUE, RED, GREEN, ORANGE, PINK, SKY, BLACK, INDIGO, OLIVE, WINE, GRAY
# of matplotlib, see `use`; what is not listed has matplotlib's default
SETTINGS: dict[Any, Any] = {
    "font.size": 9,
    "font.sans-serif": ["DejaVu Sans", "sans-serif"],  # each text of an SVG file lists them
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": plt.cycler(color=LINE_COLORS),
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "image.interpolation": "nearest",
    "svg.fonttype": "none",
    "text.parse_math": False,  # names of files and sequences may contain dollar signs
    "svg.hashsalt": "thesis-repro",  # the same figure gives the same file
    "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
    "savefig.dpi": 160,
    "figure.max_open_warning": 0,  # a study of many sources draws more than 20
}
TRUTH, BASELINE, MASKED, REDUCED = BLACK, BLUE, RED, GREEN  # ground truth and methods in chapter 4
DATES = {".svg": "Date", ".pdf": "CreationDate"}  # matplotlib's names
# note of figures that show no data
DIAGRAM = "drawn by the notebook; it does not depend on the data at hand"
# style of keypoints on a frame
KEYPOINT: dict[str, Any] = {"s": 2.5, "color": "#00e5a0", "linewidths": 0}
EDGE_COLOR = (255, 140, 0)  # red, green, blue of edges on a frame


class Artefact(NamedTuple):
    """A figure, a table or a text in Markdown, and what a page says beside it.

    name: of its files. content: a Figure, a DataFrame or a str. for_programs: whether it is a long
    table, which a page only links.
    """

    name: str
    title: str
    caption: str
    content: Any
    for_programs: bool = False


def use() -> None:
    """Let matplotlib draw in this style from now on.

    Programs and notebooks call it at their start. Settings of the user's own are reset to
    matplotlib's defaults, so that figures look the same everywhere. Matplotlib reads its settings
    when it makes a figure and again when it draws it.
    """
    matplotlib.rcdefaults()
    matplotlib.rcParams.update(SETTINGS)


@contextmanager
def applied() -> Iterator[None]:
    """Let matplotlib draw in this style within a block, and reset its settings afterwards."""
    with matplotlib.rc_context():
        use()
        yield


def line_style(index: int) -> dict[str, Any]:
    """Return colour and dash of the index-th line of a figure.

    44 styles differ; neighbours also differ in dashes.
    """
    dashes = "-", "--", "-.", ":"
    return {
        "color": LINE_COLORS[index % len(LINE_COLORS)],
        "linestyle": dashes[index % len(dashes)],
    }


def interval_style(color: str) -> dict[str, Any]:
    """Return the style of an interval along x with a cap at each end.

    The caps are longer than the mark of the mean, so that an interval shorter than it is seen, too.
    """
    return {"color": color, "linewidth": 1.8, "marker": "|", "markersize": 7}


def label_colors(label_map: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return a label map in colours, enlarged to the frame's size for display.

    masks/filter.py enlarges in another way.
    """
    height, width = frame.shape[:2]
    rows = np.arange(height) * label_map.shape[0] // height
    columns = np.arange(width) * label_map.shape[1] // width
    return colorize(label_map[np.ix_(rows, columns)])


def new_figure(
    rows: int = 1, columns: int = 1, height: float = 3.2, width: float = PAGE_WIDTH, **options: Any
) -> tuple[plt.Figure, Any]:
    """Return a figure and its axes. height, width: inches."""
    return plt.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)


def frame_panels(
    frame: np.ndarray, rows: int = 1, columns: int = 1, width: float = PAGE_WIDTH
) -> tuple[plt.Figure, list[Any]]:
    """Return a figure and a list of its axes.

    The axes have the shape of a frame and room for titles.
    """
    frame_height, frame_width = frame.shape[:2]
    panel_height = width / columns * frame_height / frame_width + 0.27
    figure, axes = new_figure(rows, columns, rows * panel_height, width, squeeze=False)
    return figure, list(axes.flat)


def show_image(axes: plt.Axes, image: np.ndarray, title: str, **options: Any) -> None:
    """Show an image without ticks; an image with one channel is gray."""
    axes.imshow(image, cmap=options.pop("cmap", "gray"), **options)
    axes.set_title(title)
    axes.set_axis_off()


def outline(axes: plt.Axes, image: np.ndarray) -> None:
    """Draw a thin border around a shown image, whose edges may be white."""
    height, width = image.shape[:2]
    border = Rectangle((-0.5, -0.5), width, height, fill=False, linewidth=0.5, clip_on=False)
    axes.add_patch(border)


def legend_below(figure: Any, panels: Iterable[plt.Axes], columns: int) -> None:
    """Add a legend below the figure with each label of the panels once."""
    handles: dict[str, Any] = {}
    for panel in panels:
        panel_handles, labels = panel.get_legend_handles_labels()
        handles |= dict(zip(labels, panel_handles))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def class_legend(figure: plt.Figure, *label_maps: np.ndarray, also: Iterable[Any] = ()) -> None:
    """Add a legend of the classes in label maps below a figure, and make the figure higher.

    also: further handles.
    """
    ids = np.unique(np.concatenate([np.unique(label_map) for label_map in label_maps]))
    names: dict[tuple, list[str]] = {}  # some Cityscapes labels share a colour
    for index in ids:
        names.setdefault(LABELS[index].color, []).append(LABELS[index].name)
    handles: list[Any] = []
    for color, labels in names.items():
        handles.append(Patch(color=tuple(np.array(color) / 255), label=", ".join(labels)))
    handles += also
    columns, lines = 5, 1
    if figure.get_figwidth() <= COLUMN_WIDTH:
        columns = 3
        for handle in handles:
            handle.set_label(fill(handle.get_label(), LEGEND_LETTERS))
        lines = max(handle.get_label().count("\n") + 1 for handle in handles)
    rows = -(-len(handles) // columns) * lines
    figure.set_figheight(figure.get_figheight() + 0.1 + 0.16 * rows)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=7, markerscale=2
    )


def ratio_axis(axis: Any, values: np.ndarray | list[float]) -> None:
    """Make an axis (such as axes.yaxis) logarithmic.

    It gets a few round ticks, and limits around the positive values.
    """
    positive = np.asarray(values, float)
    positive = positive[np.isfinite(positive) & (positive > 0)]
    low, high = positive.min(), positive.max()
    least_margin = 1.1 if high < 1.1 * low else 1
    margin = max((high / low) ** 0.05, least_margin)
    low, high = low / margin, high * margin
    locator: Locator
    if high < 5 * low:
        # ticks at equal differences are rounder here than ticks at equal ratios
        locator = MaxNLocator(5)
    elif high < 100 * low:
        locator = LogLocator(subs=(1, 2, 5), numticks=6)
    else:
        locator = LogLocator(subs=(1,), numticks=6)
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    axis.set_major_locator(locator)
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def ratio_rows(panel: plt.Axes, names: list[str], reach: float) -> None:
    """Give a panel a row for each name, the first on top, and an axis of ratios.

    The axis goes from 1 / reach to reach, with a line at 1.
    """
    ratio_axis(panel.xaxis, [1 / reach, reach])
    panel.axvline(1, color="black", linewidth=0.8)
    panel.grid(axis="y", visible=False)
    panel.set_yticks(range(len(names)), names)
    panel.set_ylim(len(names) - 0.5, -0.7)


def save_figure(figure: plt.Figure, folder: Path, name: str, note: str) -> str:
    """Write folder/name.webp if the figure contains images, else folder/name.svg; return its name.

    The data note is at the foot of the figure, no wider than it, and in the file's metadata.
    """
    _write_at_foot(figure, note)
    if any(axes.images for axes in figure.axes):
        ending, other, note_in_file = ".webp", ".svg", Image.Exif()
        note_in_file[ExifTags.Base.ImageDescription] = note
        options: dict[str, Any] = {"pil_kwargs": {"quality": 75, "exif": note_in_file}}
    else:
        ending, other = ".svg", ".webp"
        options = {"metadata": {"Creator": None, "Description": note}}
    write_figure(figure, folder / f"{name}{ending}", **options)
    # an earlier run may have written the other format
    (folder / f"{name}{other}").unlink(missing_ok=True)
    return f"{name}{ending}"


def _write_at_foot(figure: plt.Figure, note: str) -> None:
    """Write a note below a figure, no wider than it."""
    # a tight box would move legends at the figure's edge onto the note, so their places are fixed
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for legend in figure.legends:
        box = legend.get_window_extent().transformed(figure.transFigure.inverted())
        legend.borderaxespad = 0
        legend.set_loc("lower left")
        legend.set_bbox_to_anchor((box.x0, box.y0), transform=figure.transFigure)
    box = figure.get_tightbbox()  # inches
    figure.text(
        (box.x0 + box.x1) / 2 / figure.get_figwidth(),
        -0.08 / figure.get_figheight(),
        fill(note, int(NOTE_LETTERS * box.width)),
        fontsize=6,
        color="#777777",
        ha="center",
        va="top",
    )


def write_figure(figure: plt.Figure, path: str | Path, **options: Any) -> None:
    """Write a figure in the format that the path's ending names, without a date."""
    ending = Path(path).suffix.lower()
    tight: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.04}
    if ending in DATES:
        options["metadata"] = {DATES[ending]: None} | options.get("metadata", {})
    with atomic(path) as temporary:
        figure.savefig(temporary, **tight | options)
        if ending == ".svg":
            svg = temporary.read_text(encoding="utf-8")
            temporary.write_text(same_on_all_processors(svg), encoding="utf-8")


def same_on_all_processors(svg: str) -> str:
    """Return the text of an SVG file without what the last bits of its coordinates change.

    Sums of numbers end in other bits with wider vector instructions, and Matplotlib can neither
    round coordinates nor name clip paths by anything but a digest of them. So coordinates have
    three decimals in place of six, and clip paths are numbered.
    """
    names = dict.fromkeys(re.findall(r'id="([a-z][0-9a-f]{10})"', svg))
    for number, name in enumerate(names, 1):
        svg = re.sub(rf'(id="|url\(#|href="#){name}\b', rf"\1shared{number}", svg)
    number_in_tag = r"(?<![\w.#-])(-?\d+\.\d{4,}|-0(?![\w.]))(?=[^<>]*>)"  # not those of texts
    return re.sub(number_in_tag, _rounded, svg)


def _rounded(number: re.Match) -> str:
    text = f"{float(number[0]):.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def save_table(table: pd.DataFrame, folder: Path, name: str, note: str) -> None:
    """Write folder/name.csv and folder/name.md with the data note under the Markdown table."""
    save_csv(table, folder / f"{name}.csv")
    write_text(folder / f"{name}.md", f"{markdown(table)}\n{in_markdown(note)}\n")


def save_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV."""
    # spreadsheets take a text that begins so for a formula
    cells = table.replace({r"^([=+@-])": r"'\1", r"\*\*": ""}, regex=True)
    write_text(path, cells.to_csv(index=False, lineterminator="\n"))


def save(artefact: Artefact, folder: Path, note: str) -> list[str]:
    """Write an artefact, and return the names of its files; an empty table has none."""
    name, content = artefact.name, artefact.content
    if isinstance(content, str):
        write_text(folder / f"{name}.md", content)
        return [f"{name}.md"]
    if isinstance(content, pd.DataFrame):
        if content.empty:
            return []
        if artefact.for_programs:
            save_csv(content, folder / f"{name}.csv")
            return [f"{name}.csv"]
        save_table(content, folder, name, note)
        return [f"{name}.csv", f"{name}.md"]
    written = save_figure(content, folder, name, note)
    plt.close(content)
    return [written]


def markdown(table: pd.DataFrame) -> str:
    """Return a pandas table as Markdown, an empty one as "".

    Numbers are aligned to the right, and missing values are empty. Names are no HTML. What
    stands between ** is bold.
    """
    if table.empty:
        return ""
    numeric = [pd.api.types.is_numeric_dtype(table[column]) for column in table]
    rows = [list(map(_cell, table.columns)), ["---:" if right else ":---" for right in numeric]]
    rows += [list(map(_cell, row)) for row in table.itertuples(index=False)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _cell(value: Any) -> str:
    if pd.isna(value):
        return ""
    if isinstance(value, float):
        return f"{value:g}"
    return in_markdown(value).replace(r"\*\*", "**")
