"""What a lesson that is opened first makes: the files of earlier ones, by the package's functions.

They are those that the lessons write as they are in git, to the bit. What is there stays.
"""

import json
from collections.abc import Iterable
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
from thesis_repro.running import files, provenance

EVIDENCE = ROOT / "figures/kitti_excerpts"
SPLITS = ("train", "validation", "test")
VALIDATION_SHARE = 0.2  # of the training images, as in notebook 1


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
    artefacts.write_text(artefacts.LABELS_BY, artefacts.IN_PACKAGE)
    return labels


def masks_json() -> dict[str, Any]:
    """Return the settings of the masks of notebook 6; without it, the thesis's."""
    path = read_settings().build / "masks.json"
    return json.loads(path.read_text()) if path.is_file() else {"width": CONTROL_WIDTH}


def images() -> None:
    """Write the arrays of notebook 1."""
    settings = read_settings()
    if _are_there(f"{split}_{kind}" for split in SPLITS for kind in ("images", "labels")):
        return
    print("reads the training images, as notebook 1 does", flush=True)
    from sklearn.model_selection import train_test_split

    if settings.cityscapes_is_embedded:
        world = settings.sizes.world | {"seed": settings.seed, "jobs": settings.jobs}
        street_world.write(settings.world, **world, replace=True, only="cityscapes")
    loaded = {}
    for split in ("train", "val"):
        pairs = cityscapes.pairs(settings.cityscapes, split, settings.sizes.training_images)
        loaded[split] = cityscapes.load(pairs, settings.sizes.image_size)
    parts = train_test_split(*loaded["train"], test_size=VALIDATION_SHARE, random_state=0)
    of_split = {"train": parts[::2], "validation": parts[1::2], "test": loaded["val"]}
    for split, arrays in of_split.items():
        _write(split, *arrays)


def doubled_images() -> None:
    """Write the doubled arrays of notebook 2."""
    if _are_there(f"doubled_{split}_{x}" for split in SPLITS[:2] for x in ("images", "labels")):
        return
    images()
    print("doubles the training images, as notebook 2 does", flush=True)
    from thesis_repro.segmentation import augmentation

    data, seed = read_settings().build / "data", read_settings().seed
    for number, split in enumerate(SPLITS[:2]):
        arrays = tuple(np.load(data / f"{split}_{kind}.npy") for kind in ("images", "labels"))
        size = arrays[0].shape[1]
        transforms = [augmentation.training_augmenter(size), augmentation.validation_augmenter()]
        copies = augmentation.augment_set(arrays[0], arrays[1], transforms[number], seed + number)
        _write(f"doubled_{split}", *map(np.concatenate, zip(arrays, copies)))


def network() -> Path:
    """Return the file of the network of notebook 3 with its initial weights."""
    settings = read_settings()
    path = settings.build / "network.keras"
    if not path.is_file():
        import keras

        from thesis_repro.segmentation import unet

        print("builds the network, as notebook 3 does", flush=True)
        keras.utils.clear_session()
        keras.utils.set_random_seed(settings.seed)
        size = settings.sizes.image_size
        model = unet.build_unet((size, size, 1), cityscapes.N_CLASSES, settings.sizes.base_filters)
        with files.atomic(path) as temporary:
            model.save(temporary)
    return path


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
        folder, whose = build, f"this run, label maps: by {_network_of_runs(build)}"
    tables = [
        pd.read_csv(folder / name, dtype={"sequence": str}, low_memory=False)
        for name in ("runs.csv", "shuffled_runs.csv")
    ]
    return tables[0], tables[1], whose


def _network_of_runs(build: Path) -> str:
    """Return in words which network made the label maps that the masks of runs.csv were made of.

    The record of a run has the digest of its label maps. Those that another network replaced lie in
    a folder beside the new ones.
    """
    networks = {None}
    for place in sorted((build / "odometry").glob("*/settings.json")):
        used = {run["files"] for run in json.loads(place.read_text()).values() if run["masks"]}
        for folder in sorted((build / "labels").glob(f"{place.parent.name}*")):
            record = provenance.record(folder)
            if record and provenance.digest_of_files(files.listed(folder)) in used:
                networks.add(record["model"])
    networks.discard(None)
    if networks == {artefacts.NETWORK_IN_PACKAGE}:
        said = artefacts.IN_PACKAGE
    else:
        said = "the model of this run" if len(networks) == 1 else "models that no record tells"
    now = artefacts.network_of_label_maps()
    return said if networks == {now} else f"{said} (replaced since: run notebook 8 again)"


def _are_there(names: Iterable[str]) -> bool:
    data = read_settings().build / "data"
    return all((data / f"{name}.npy").is_file() for name in names)


def _write(split: str, images: np.ndarray, label_maps: np.ndarray) -> None:
    data = read_settings().build / "data"
    files.write_array(data / f"{split}_images.npy", images)
    files.write_array(data / f"{split}_labels.npy", label_maps)
