"""Faults of a drawn figure: raw TeX, missing glyphs and texts that overlap."""

import functools
import itertools
import sys
import warnings

from matplotlib.text import Text


def problems(figure):
    """Messages about the faults of a figure; none if it has no faults."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        figure.draw_without_rendering()
    faults = [str(warning.message) for warning in caught]
    texts = _visible_texts(figure)
    faults += [
        f"raw TeX: {text.get_text()}"
        for text in texts
        if "mathdefault" in text.get_text() or "$" in text.get_text() and not text.get_parse_math()
    ]
    # an overlap of one pixel is allowed
    boxes = {text: Text.get_window_extent(text).padded(-1) for text in texts}
    faults += [
        f"{text.get_text()!r} lies over {other.get_text()!r}"
        for text, other in itertools.combinations(texts, 2)
        if boxes[text].overlaps(boxes[other])
    ]
    return faults


def _visible_texts(figure):
    hidden = set()  # texts that matplotlib holds but does not draw
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            if not axes.axison:
                hidden.add(axis.label)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not axes.axison or not low <= tick.get_loc() <= high:
                    hidden |= {tick.label1, tick.label2}
    # slanted texts are left out, since their boxes are much larger than they are
    return [
        text
        for text in figure.findobj(Text)
        if text not in hidden
        and text.get_visible()
        and text.get_text().strip()
        and text.get_rotation() % 90 == 0
    ]


def watch(shell, path):
    """Append the faults of every figure that the notebook of an IPython shell saves to a file.

    Also the number of figures that a cell has made but not shown.
    """

    def wrap_save_figure(_):
        style = sys.modules.get("thesis_repro.report.style")
        if style is None or hasattr(style.save_figure, "__wrapped__"):
            return
        save_figure = style.save_figure

        @functools.wraps(save_figure)
        def checked(figure, folder, name, note):
            with open(path, "a", encoding="utf-8") as file:
                file.writelines(f"{name}: {fault}\n" for fault in ["saved", *problems(figure)])
            save_figure(figure, folder, name, note)

        style.save_figure = checked

    def report_hidden(_):
        pyplot = sys.modules.get("matplotlib.pyplot")
        if pyplot and pyplot.get_fignums():
            with open(path, "a", encoding="utf-8") as file:
                file.write(f"{len(pyplot.get_fignums())} figures are not shown\n")

    shell.events.register("post_run_cell", wrap_save_figure)
    shell.events.register("post_run_cell", report_hidden)
