"""Where a notebook finds the files of earlier ones, and where its figures and tables go."""

import gc
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd

from keypoint_study.report import style
from thesis.settings import Settings, read_settings
from thesis_repro.running import files, program


def begin() -> Settings:
    """Begin a notebook: set the style of the figures, and return the settings of the run."""
    style.use()
    program.keep_freed_memory()
    gc.freeze()  # what was imported is no garbage; not to look at it again spares time
    settings = read_settings()
    print(settings)
    return settings


def needed(name: str, notebook: str) -> Path:
    """Return the path of a file or folder in the folder of the run.

    notebook: writes it. Raises InputError with its name if the file does not exist.
    """
    return files.needed(read_settings().build / name, notebook)


def used_model() -> Any:
    """Load the model that made the label maps of the run, chosen as in notebook 5."""
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction, training
    if read_settings().uses_shipped_model:
        return prediction.load_shipped()
    return training.load_model(needed("model/model.keras", "04_training"))


def write_text(name: str, text: str) -> None:
    """Write a text into a file in the folder of the run."""
    files.write_text(read_settings().build / name, text)


def save_figure(figure: plt.Figure, name: str, note: str = "") -> None:
    """Save a figure of the thesis. note: names its data; by default that of the run."""
    settings = read_settings()
    style.save_figure(figure, settings.figures, name, note or settings.data_note)


def save_table(table: pd.DataFrame, name: str, folder: Path | None = None, note: str = "") -> None:
    """Save a table as CSV and Markdown, by default in the folder of the figures. note: as above."""
    settings = read_settings()
    style.save_table(table, folder or settings.figures, name, note or settings.data_note)


def with_sliders(draw: Callable[..., plt.Figure], **sliders: Any) -> None:
    """Show the figure that `draw` returns, with sliders of ipywidgets for its arguments.

    What shows no sliders, such as nbconvert or a repository's page, shows the first figure.
    """
    from IPython.core.pylabtools import print_figure
    from IPython.display import display
    from ipywidgets import Image, VBox

    picture = Image(layout={"width": "720px"})

    def redraw(_: Any = None) -> None:
        values = {name: slider.value for name, slider in sliders.items()}
        picture.value = print_figure(draw(**values), dpi=150)
        plt.close()

    for slider in sliders.values():
        slider.observe(redraw, "value")
    redraw()
    both = VBox([*sliders.values(), picture])._repr_mimebundle_()
    display(both | {"image/png": b64encode(picture.value).decode()}, raw=True)
