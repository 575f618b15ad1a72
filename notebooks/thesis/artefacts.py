"""Where a notebook finds the files of earlier ones, and where its figures and tables go."""

import gc
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd

import street_world
from keypoint_study.report import style
from thesis.settings import Settings, read_settings
from thesis_repro.data import kitti
from thesis_repro.running import files, program

LABELS_BY = "labels_by.txt"  # in the folder of the run: who made the label maps
IN_PACKAGE = "the model in the package"


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
    """Load the model that made the label maps of the run."""
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction, training
    settings = read_settings()
    if settings.uses_shipped_model or _by_model_in_package(settings):
        return prediction.load_shipped()
    return training.load_model(needed("model/model.keras", "04_training"))


def predict_with_model_in_package() -> None:
    """Do what notebook 5 does, with the model in the package: a notebook is opened first.

    The embedded world is rendered if it is used. Notebook 5 replaces the label maps.
    """
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction
    settings = read_settings()
    if settings.kitti_is_embedded:
        world = settings.sizes.world | {"seed": settings.seed, "jobs": settings.jobs}
        street_world.write(settings.world, **world, only="kitti", replace=True)
    model = prediction.load_shipped()
    for name in kitti.sequences(settings.kitti):
        drive = kitti.Sequence(settings.kitti, name).subset(settings.sizes.frames)
        prediction.write_label_maps(model, drive.frame_paths, settings.build / "labels" / name)
    write_text(LABELS_BY, IN_PACKAGE)


def data_note() -> str:
    """Return what figures and tables say about the data of the run, and of its label maps."""
    settings = read_settings()
    if _by_model_in_package(settings) and not settings.uses_shipped_model:
        return f"{settings.data_note}; label maps: by {IN_PACKAGE}"
    return settings.data_note


def _by_model_in_package(settings: Settings) -> bool:
    made_by = settings.build / LABELS_BY
    return made_by.is_file() and made_by.read_text() == IN_PACKAGE


def write_text(name: str, text: str) -> None:
    """Write a text into a file in the folder of the run."""
    files.write_text(read_settings().build / name, text)


def save_figure(figure: plt.Figure, name: str, note: str = "") -> None:
    """Save a figure of the thesis. note: names its data; by default that of the run."""
    settings = read_settings()
    style.save_figure(figure, settings.figures, name, note or data_note())


def save_table(table: pd.DataFrame, name: str, folder: Path | None = None, note: str = "") -> None:
    """Save a table as CSV and Markdown, by default in the folder of the figures. note: as above."""
    settings = read_settings()
    style.save_table(table, folder or settings.figures, name, note or data_note())


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
