"""Faults of a drawn figure: raw TeX, missing glyphs and texts that overlap."""

import functools
import gc
import itertools
import os
import sys
import warnings

from matplotlib.text import Text

END = "# after the last cell"  # of a notebook, a cell that the tests append


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


class Watch:
    """What is seen of the notebook of an IPython shell, written into a folder.

    faults.txt has the faults of every figure that the notebook saves, and the number of figures
    that a cell has made but not shown. sliders-NUMBER.txt has the texts of each figure with
    sliders, drawn again after the last cell. The variable WATCHED has the number of the notebook.
    """

    def __init__(self, shell, folder):
        self.folder, self.with_sliders = folder, []
        for function in (self.wrap_functions_of_style, self.report_hidden, self.draw_again):
            shell.events.register("post_run_cell", function)

    def report(self, *lines, name="faults"):
        with open(f"{self.folder}/{name}.txt", "a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)

    def wrap_functions_of_style(self, _):
        artefacts = sys.modules.get("thesis.artefacts")
        if artefacts is None or hasattr(artefacts.style.save_figure, "__wrapped__"):
            return
        style = artefacts.style
        sys.modules["matplotlib"].rcParams["savefig.dpi"] = 50  # nobody looks at them
        gc.freeze()  # as in conftest.py
        gc.set_threshold(20_000)
        save_figure, show_sliders = style.save_figure, artefacts.with_sliders

        @functools.wraps(save_figure)
        def checked(figure, folder, name, note):
            faults = ["saved"]

            def draw():  # in place of the first drawing by save_figure, which takes a while
                del figure.draw_without_rendering
                faults.extend(problems(figure))

            figure.draw_without_rendering = draw
            save_figure(figure, folder, name, note)
            self.report(*(f"{name}: {fault}" for fault in faults))

        def remembered(draw, **sliders):
            self.with_sliders.append((draw, sliders))
            show_sliders(draw, **sliders)

        style.save_figure, artefacts.with_sliders = checked, remembered

    def report_hidden(self, _):
        pyplot = sys.modules.get("matplotlib.pyplot")
        if pyplot and pyplot.get_fignums():
            self.report(f"{len(pyplot.get_fignums())} figures are not shown")

    def draw_again(self, result):
        if result.info.raw_cell != END:
            return
        name = f"sliders-{os.environ['WATCHED']}"
        for draw, sliders in self.with_sliders:
            figure = draw(**{key: slider.value for key, slider in sliders.items()})
            texts = [text for axes in figure.axes for text in (axes.title, *axes.texts)]
            self.report("; ".join(text.get_text() for text in texts), name=name)
