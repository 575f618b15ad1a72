"""Settings of a run: where the data is, how large the run is and where its results go.

They are read from environment variables whose names start with THESIS_REPRO_. `make figures
KITTI=... PROFILE=...` sets these variables.
"""

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from joblib import cpu_count as cores

import street_world
from thesis_repro.errors import InputError
from thesis_repro.masks import WIDTHS
from thesis_repro.running import program
from thesis_repro.running.values import list_of_widths, number_of_frames, positive_whole_number

# the checkout, also for a copy of this folder, as `make lab` makes
ROOT = Path(street_world.__file__).resolve().parents[1]
if not (ROOT / "Makefile").is_file():  # packages that pip installed have no figures, and no folder
    raise InputError(f"{ROOT}: is no checkout, which the notebooks need; clone it, run make setup")
PREFIX = "THESIS_REPRO_"


@dataclass(frozen=True)
class Profile:
    """Sizes of a run. None means no limit. The same code runs for every profile."""

    image_size: int  # width and height of the network's input, pixels
    base_filters: int  # channels of the U-Net's first block
    batch_size: int
    learning_rate: float  # of Adam
    rate_falls: bool  # evenly to zero over the epochs; the thesis's does not
    # of TensorFlow in training; fixed, because another number of threads changes the trained
    # weights
    threads: int
    epochs: int
    patience: int  # epochs without a lower validation loss before training stops
    training_images: int | None  # images taken from the training split
    frames: int | None  # frames taken from the start of each sequence
    # frames of each sequence on which the odometry is timed for each dilation width
    timed_frames: int
    widths: tuple  # dilation widths, pixels
    repetitions: int  # of each run; each repetition shuffles the matched points with another seed
    world: dict  # sizes of the embedded world, as arguments of `street_world.write`


PROFILES = {
    "smoke": Profile(
        image_size=64,
        base_filters=4,
        batch_size=4,
        learning_rate=0.001,
        rate_falls=False,
        threads=1,
        epochs=2,
        patience=5,
        training_images=16,
        frames=5,
        timed_frames=3,
        widths=(5, 10),
        repetitions=2,
        world=street_world.SIZES["smoke"],
    ),
    # For a course: a notebook takes up to two minutes on two cores. Six short drives are enough for
    # an interval.
    "lab": Profile(
        image_size=128,
        base_filters=8,
        batch_size=2,
        learning_rate=0.004,
        rate_falls=False,
        threads=1,
        epochs=6,
        patience=5,
        training_images=60,
        frames=25,
        timed_frames=5,
        widths=(1, 5, 10, 15),
        repetitions=2,
        world=street_world.SIZES["lab"],
    ),
    # The thesis's loss needs many steps. Small batches and a higher learning rate, which falls, get
    # further in the same time.
    "demo": Profile(
        image_size=96,
        base_filters=8,
        batch_size=2,
        learning_rate=0.004,
        rate_falls=True,
        threads=1,
        epochs=12,
        patience=5,
        training_images=200,
        frames=25,
        timed_frames=5,
        # the thesis has all 15; these show the same curve in less time
        widths=(1, 3, 5, 10, 15),
        repetitions=2,
        world=street_world.SIZES["demo"],
    ),
    "thesis": Profile(
        image_size=320,
        base_filters=64,
        batch_size=16,
        learning_rate=0.001,
        rate_falls=False,
        threads=8,
        epochs=100,
        patience=5,
        training_images=None,
        frames=None,
        timed_frames=12,
        widths=WIDTHS,
        repetitions=5,
        world=street_world.SIZES["thesis"],
    ),
}


@dataclass(frozen=True)
class Settings:
    """Settings of one run.

    `run` names its data and sizes, so that runs with other settings use other folders.
    """

    profile: str
    sizes: Profile
    kitti: Path  # the user's KITTI folder, an excerpt of it, or the one of the embedded world
    cityscapes: Path
    kitti_is_embedded: bool
    cityscapes_is_embedded: bool
    run: str
    build: Path  # folder of all results of this run
    figures: Path  # folder that its figures and tables are written to
    published: Path  # folder that `make figures` copies the figures and tables to
    world: Path  # folder that the embedded world is written to
    jobs: int
    scheduler: str | None = None  # address of a Dask scheduler
    kitti_semantic: Path | None = None  # the user's folder of KITTI street scenes with label maps
    seed: int = 0
    # name, first and last frame of each sequence, if `kitti` has only these of the user's folder
    ranges: tuple[tuple[str, int, int], ...] = ()
    whole: Path | None = None  # the user's folder then

    @property
    def uses_shipped_model(self) -> bool:
        """Whether the shipped model makes the label maps.

        It does if there are real frames, but no real images to train on.
        """
        return self.cityscapes_is_embedded and not self.kitti_is_embedded

    @property
    def figures_in_git(self) -> bool:
        """Whether the figures of this run are those in git: the default run's."""
        return self.published == ROOT / "figures"

    @property
    def data_note(self) -> str:
        """One line for captions that names the data and the sizes of the run."""
        odometry = "real KITTI frames"
        if self.kitti_is_embedded:
            odometry = "embedded world (rendered)"
        labels = "training: the user's Cityscapes folder"
        if self.uses_shipped_model:
            labels = "label maps: by the model in the package, no training"
        elif self.cityscapes_is_embedded:
            labels = "training: embedded world (rendered)"
        parts = [f"profile {self.profile}"]
        for name, text in _changed_sizes(self.profile, self.sizes).items():
            parts.append(f"{name} {text}")
        return f"odometry: {odometry}; {labels}; {', '.join(parts)}"

    def __str__(self) -> str:
        return f"run {self.run}; results: {os.path.relpath(self.build, ROOT)}"


# How settings are read. Each function raises ValueError for a text of another kind, and its name
# says in messages which kind is wanted.


def profile_name(text: str) -> str:
    """Return the name of a profile."""
    if text not in PROFILES:
        raise ValueError
    return text


def folder(text: str) -> Path:
    """Return the path that a text names; a relative one starts at the checkout."""
    return ROOT / Path(text).expanduser()


def existing_folder(text: str) -> Path:
    """Return the path of a folder that must exist."""
    if not folder(text).is_dir():
        raise ValueError
    return folder(text)


def path_of_letters_digits_and_dashes(text: str) -> Path:
    """Return a path without what make takes for its own, such as spaces, colons and percent."""
    if not re.fullmatch(r"[\w/.,+@~-]+", text):
        raise ValueError
    return folder(text)


def number_of_frames_or_ranges(text: str) -> int | tuple | None:
    """Return a number of frames, None for "all", or ranges.

    A range has a sequence, its first and its last frame: "00:0-129,04:0-37" is
    (("00", 0, 129), ("04", 0, 37)).
    """
    if ":" not in text:
        return number_of_frames(text)
    ranges = {}
    for word in text.split(","):
        found = re.fullmatch(r"([\w.+-]+):(\d+)-(\d+)", word)
        if found is None or found[1] in ranges or int(found[2]) > int(found[3]):
            raise ValueError
        ranges[found[1]] = int(found[2]), int(found[3])
    return tuple((name, *ranges[name]) for name in sorted(ranges))


DATA = {"KITTI": existing_folder, "CITYSCAPES": existing_folder, "KITTI_SEMANTIC": existing_folder}
SIZES: dict[str, Callable] = {  # of a profile
    "IMAGE_SIZE": positive_whole_number,
    "BASE_FILTERS": positive_whole_number,
    "BATCH_SIZE": positive_whole_number,
    "EPOCHS": positive_whole_number,
    "FRAMES": number_of_frames_or_ranges,
    "WIDTHS": list_of_widths,
    "REPETITIONS": positive_whole_number,
}
SETTINGS: dict[str, Callable] = (
    DATA
    | SIZES
    | {
        "PROFILE": profile_name,
        "BUILD": path_of_letters_digits_and_dashes,
        "FIGURES": folder,
        "JOBS": positive_whole_number,
        "DASK_SCHEDULER": str,
        "PROGRESS": str,  # the file or terminal that progress bars are written to
    }
)


def read_settings(environment: Mapping[str, str] | None = None) -> Settings:
    """Return the settings that the THESIS_REPRO_ variables of an environment give.

    The default is os.environ. Raises InputError for an unknown variable, a data folder that does
    not exist, and a bad number.
    """
    if environment is None:
        environment = os.environ
    values: dict[str, Any] = {}
    for variable, text in environment.items():
        name = variable.removeprefix(PREFIX)
        if name != variable and text:
            values[name] = _read(name, text)
    profile = values.get("PROFILE", "demo")
    folders = {name: values[name] for name in DATA if name in values}
    changes = {name.lower(): values[name] for name in SIZES if name in values}
    ranges = changes["frames"] if isinstance(changes.get("frames"), tuple) else ()
    if ranges:
        changes["frames"] = None  # all of what is cut
        if "KITTI" not in folders:
            raise InputError("FRAMES: ranges of frames are those of a folder KITTI=...; give both")
    sizes = replace(PROFILES[profile], **changes)
    run = "-".join([_run_name(folders, profile, sizes), *("_".join(map(str, r)) for r in ranges)])
    published = values.get("FIGURES", ROOT / "figures")
    if run != "embedded-demo":
        # figures/ holds the figures of the default run; every other run gets a folder in it
        published /= run
    build = values.get("BUILD", ROOT / "build")
    world = build / f"world-{profile}"
    kitti = folders.get("KITTI", world / "kitti")
    return Settings(
        profile=profile,
        sizes=sizes,
        kitti=build / run / "frames" if ranges else kitti,
        cityscapes=folders.get("CITYSCAPES", world / "cityscapes"),
        kitti_is_embedded="KITTI" not in folders,
        cityscapes_is_embedded="CITYSCAPES" not in folders,
        run=run,
        build=build / run,
        figures=build / run / "figures",
        published=published,
        world=world,
        jobs=values.get("JOBS") or cores(),
        scheduler=values.get("DASK_SCHEDULER"),
        kitti_semantic=folders.get("KITTI_SEMANTIC"),
        ranges=ranges,
        whole=kitti if ranges else None,
    )


def _read(name: str, text: str) -> Any:
    if name not in SETTINGS:
        raise InputError(f"{name}: unknown setting; known are {', '.join(SETTINGS)}")
    try:
        return SETTINGS[name](text)
    except ValueError:
        kind = SETTINGS[name].__name__.replace("_", " ")
        raise InputError(f"{name}={text}: is no {kind}") from None


def _run_name(folders: dict[str, Path], profile: str, sizes: Profile) -> str:
    """Name of the run: its data, its profile, and the sizes that differ from the profile's."""
    data = []
    for name, folder in folders.items():
        # make and shells treat other characters specially
        letters = re.sub(r"[^\w.+-]+", "-", folder.name)
        # for folders of the same name
        path_digest = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:6]
        kind = name.lower().removeprefix("kitti_")
        data.append(f"{kind}-{letters}-{path_digest}")
    if not folders.keys() & {"KITTI", "CITYSCAPES"}:
        data.insert(0, "embedded")
    parts = ["_".join(data), profile]
    for name, text in _changed_sizes(profile, sizes).items():
        parts.append(f"{name.replace(' ', '-')}-{text.replace(', ', '_')}")
    return "-".join(parts)


def _changed_sizes(profile: str, sizes: Profile) -> dict[str, str]:
    """The sizes that differ from the profile's, as text by name ("image size")."""
    texts = {}
    for field in map(str.lower, SIZES):
        value = getattr(sizes, field)
        if value != getattr(PROFILES[profile], field):
            text = str(value).strip("(),")  # of (5, 10), or of 5
            texts[field.replace("_", " ")] = text.replace("None", "all")
    return texts


if __name__ == "__main__":  # the Makefile asks for the folder of the run, below its own
    program.run_main(lambda: print(os.path.relpath(read_settings().build, ROOT)))
