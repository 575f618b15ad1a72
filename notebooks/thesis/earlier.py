"""What a lesson that is opened first makes: rendered sequences and label maps.

What is there stays.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import street_world
from keypoint_study.jobs import CONTROL_WIDTH
from thesis import artefacts
from thesis.settings import ROOT, read_settings
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence

EVIDENCE = ROOT / "figures/kitti_excerpts"


def drives() -> list[Sequence]:
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
    if artefacts.network_of_label_maps() not in (None, artefacts.NETWORK_IN_PACKAGE):
        return labels
    missing = []
    for drive in drives():
        paths = [labels / drive.name / f"{path.stem}.png" for path in drive.frame_paths]
        if not all(path.is_file() for path in paths):
            missing.append(drive)
    if not missing:
        return labels
    print(f"{artefacts.IN_PACKAGE} makes the label maps, once: a minute or less", flush=True)
    from thesis_repro.segmentation import quietly

    with quietly():  # what TensorFlow prints when it starts is no error
        from thesis_repro.segmentation import prediction
    model = prediction.load_shipped()
    for drive in missing:
        folder = labels / drive.name
        prediction.write_label_maps(model, drive.frame_paths, folder, lens=drive.lens)
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
    folder, whose = EVIDENCE, "the real streets in git, because notebook 8 was not run"
    if (build / "shuffled_runs.csv").is_file():
        folder, whose = build, "this run"
    tables = [
        pd.read_csv(folder / name, dtype={"sequence": str}, low_memory=False)
        for name in ("runs.csv", "shuffled_runs.csv")
    ]
    return tables[0], tables[1], whose
