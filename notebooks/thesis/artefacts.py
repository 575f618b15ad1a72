"""Where a notebook finds the files of earlier ones, and where its figures and tables go."""

import gc
import json
import os
from base64 import b64encode
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from numba.core import event as numba_events

import street_world
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.report import style
from thesis import real_frames
from thesis.run_settings import PREFIX, Settings, read_settings
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import files, program, provenance

IN_PACKAGE = "the model in the package"
NETWORK_IN_PACKAGE = "11a5270f8fd2"  # its digest in records of label maps, without TensorFlow


class _Waiting(numba_events.Listener):
    """Says once in a lesson that it compiles: what is compiled is then on disk."""

    has_said = False

    def on_start(self, event: Any) -> None:
        if not self.has_said:
            print("compiling, needed once: a minute, or more on a busy machine", flush=True)
        self.has_said = True

    def on_end(self, event: Any) -> None:
        pass


@cache
def say_that_it_compiles() -> None:
    """Let whatever Numba compiles from now on be told to who waits for it.

    Nobody waits in a notebook that `make figures` executes, whose outputs are published.
    """
    if f"{PREFIX}PROGRESS" not in os.environ:
        numba_events.register("numba:compile", _Waiting())


def begin() -> Settings:
    """Begin a notebook: set the style of the figures, and return the settings of the run."""
    style.use()
    program.keep_freed_memory()
    say_that_it_compiles()
    gc.freeze()  # what was imported is no garbage; not to look at it again spares time
    settings = read_settings()
    print(settings)
    return settings


def needed(name: str, notebook: str) -> Path:
    """Return the path of a file or folder in the folder of the run.

    notebook: writes it. Raises InputError with its name if the file does not exist.
    """
    return files.needed(read_settings().build / name, notebook)


def is_trained() -> bool:
    """Return whether notebook 4 has trained a model of this run."""
    settings = read_settings()
    return not settings.uses_shipped_model and (settings.build / "model/model.keras").is_file()


def model_of_run() -> Any:
    """Load the model that notebook 5 uses: the trained one, or that in the package if none is."""
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction, training
    if not is_trained():
        return prediction.load_shipped()
    return training.load_model(read_settings().build / "model/model.keras")


def used_model() -> Any:
    """Load the model that made the label maps of the run.

    Raises InputError if it is neither the model of the run nor that in the package.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction, training
    network = network_of_label_maps()
    if network == NETWORK_IN_PACKAGE:
        return prediction.load_shipped()
    model = model_of_run()
    if network != training.weights_digest(model):
        raise InputError(
            f"{read_settings().build / 'labels'}: not by the network of this run, which was trained again; "
            "run notebook 05_prediction again"
        )
    return model


def data_note(whose: str = "") -> str:
    """Return what figures and tables say about the data of the run, and of its label maps.

    whose: the model that is to make them; by default the record of those in the folder tells.
    """
    settings = read_settings()
    if settings.uses_shipped_model:
        return settings.data_note
    if whose == IN_PACKAGE or (not whose and network_of_label_maps() == NETWORK_IN_PACKAGE):
        return f"{settings.data_note}; label maps: by {IN_PACKAGE}"
    return settings.data_note


def network_of_label_maps() -> str | None:
    """Return the digest of the network that made the label maps of the run, or None.

    Their record tells. Raises InputError if two networks did, because a notebook was stopped.
    """
    settings = read_settings()
    labels = settings.build / "labels"
    names = kitti.sequences(settings.kitti) if labels.is_dir() else []
    records = [provenance.record(labels / name) for name in names]
    networks = {record["model"] for record in records if record}
    if len(networks) > 1:
        raise InputError(f"{labels}: by two networks; run notebook 05_prediction again, to its end")
    return min(networks, default=None)


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


# What a lesson that is opened first makes: rendered sequences and label maps. What is there stays.


def sequences() -> list[Sequence]:
    """Return the sequences of the run. Those of the embedded world are rendered if need be."""
    settings = read_settings()
    if settings.kitti_is_embedded:
        world = settings.sizes.world | {"seed": settings.seed, "jobs": settings.jobs}
        street_world.write(settings.world, **world, only="kitti", replace=True)
    names = kitti.sequences(settings.kitti)
    return [Sequence(settings.kitti, name).subset(settings.sizes.frames) for name in names]


def label_maps() -> Path:
    """Return the folder of the label maps. Without notebook 5, the model in the package makes them.

    Notebook 5 replaces them.
    """
    labels = read_settings().build / "labels"
    if network_of_label_maps() not in (None, NETWORK_IN_PACKAGE):
        return labels
    missing = []
    for each in sequences():
        paths = [labels / each.name / f"{path.stem}.png" for path in each.frame_paths]
        if not all(path.is_file() for path in paths):
            missing.append(each)
    if not missing:
        return labels
    print(f"{IN_PACKAGE} makes the label maps, once: a minute or less", flush=True)
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction
    model, batch_size = prediction.load_shipped(), read_settings().sizes.batch_size  # as notebook 5
    for each in missing:
        folder = labels / each.name
        prediction.write_label_maps(model, each.frame_paths, folder, batch_size, lens=each.lens)
    return labels


def masks_json() -> dict[str, Any]:
    """Return the settings of the masks of notebook 6; without it, the thesis's."""
    path = read_settings().build / "masks.json"
    return json.loads(path.read_text()) if path.is_file() else {"width": CONTROL_WIDTH}


def rendered_images(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a few rendered images with label maps, to look at where nothing was trained."""
    settings = read_settings()
    world: dict[str, Any] = {
        "sequences": (),
        "train_images": 0,
        "validation_images": 4,
        "jobs": settings.jobs,
    }
    street_world.write(settings.build / "rendered", **world, only="cityscapes", replace=True)
    pairs = cityscapes.pairs(settings.build / "rendered/cityscapes", "val")
    return cityscapes.load(pairs, size)


def results() -> tuple[pd.DataFrame, pd.DataFrame, str]:
    """Return the runs of notebook 8, those that were shuffled, and whose they are, in words.

    Without notebook 8 they are those of the real streets in git.
    """
    build = read_settings().build
    folder, whose = real_frames.FOLDER, "the real streets in git, because notebook 8 was not run"
    if (build / "shuffled_runs.csv").is_file():
        folder, whose = build, "this run"
    runs, shuffled = (
        pd.read_csv(folder / name, dtype={"sequence": str}, low_memory=False)
        for name in ("runs.csv", "shuffled_runs.csv")
    )
    return runs, shuffled, whose
