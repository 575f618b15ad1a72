"""Settings of a run: where the data is, how large the run is and where its results go.

They are read from environment variables whose names start with THESIS_REPRO_. `make figures
KITTI=... PROFILE=...` sets these variables.
"""

import hashlib
import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from thesis_repro.errors import InputError

ROOT = Path(__file__).resolve().parents[2]  # of the checkout
PREFIX = "THESIS_REPRO_"
# of each number: minimum, maximum, and the step that it must be a multiple of
LIMITS = {
    "IMAGE_SIZE": (32, 4096, 16),
    "BASE_FILTERS": (1, 1024, 1),
    "BATCH_SIZE": (1, 4096, 1),
    "EPOCHS": (1, 100_000, 1),
    "FRAMES": (5, 10**7, 1),
    "WIDTHS": (1, 1000, 1),
    "REPETITIONS": (1, 1000, 1),
    "JOBS": (1, 1024, 1),
}
MOST_REPETITIONS = LIMITS["REPETITIONS"][1]
# the fields of a profile that a variable can replace
SIZES = tuple(name for name in LIMITS if name != "JOBS")
# PROGRESS is the file or terminal that progress bars are written to
VARIABLES = (
    "PROFILE",
    "KITTI",
    "CITYSCAPES",
    "KITTI_SEMANTIC",
    "BUILD",
    "FIGURES",
    "DASK_SCHEDULER",
    "PROGRESS",
    *LIMITS,
)
ALL_WIDTHS = tuple(range(1, 16))


@dataclass(frozen=True)
class Profile:
    """Sizes of a run. None means no limit. The same code runs for every profile."""

    image_size: int  # width and height of the network's input, pixels
    base_filters: int  # channels of the U-Net's first block
    batch_size: int
    learning_rate: float  # of Adam
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


def _world(
    sequences: int, frames: int | None, train_images: int, validation_images: int
) -> dict[str, Any]:
    """Sizes of the embedded world.

    frames: of each sequence; None for its whole drive, 41 to 132 frames.
    """
    return {
        "sequences": tuple(f"{number:02d}" for number in range(sequences)),
        "frames": frames,
        "train_images": train_images,
        "validation_images": validation_images,
    }


PROFILES = {
    "smoke": Profile(
        image_size=64,
        base_filters=4,
        batch_size=4,
        learning_rate=0.001,
        threads=1,
        epochs=2,
        patience=5,
        training_images=16,
        frames=12,
        timed_frames=5,
        widths=(1, 5, 10, 15),
        repetitions=2,
        world=_world(2, 12, 12, 4),
    ),
    # For a course: a notebook takes up to two minutes on two cores. Three short drives show how
    # much of a difference is chance.
    "lab": Profile(
        image_size=128,
        base_filters=8,
        batch_size=2,
        learning_rate=0.004,
        threads=1,
        epochs=6,
        patience=5,
        training_images=60,
        frames=40,
        timed_frames=5,
        widths=(1, 5, 10, 15),
        repetitions=2,
        world=_world(3, 40, 60, 12),
    ),
    # The thesis's loss needs many steps. Small batches and a higher learning rate get further in
    # the same time.
    "demo": Profile(
        image_size=128,
        base_filters=8,
        batch_size=2,
        learning_rate=0.004,
        threads=1,
        epochs=16,
        patience=5,
        training_images=200,
        frames=200,
        timed_frames=5,
        widths=ALL_WIDTHS,
        repetitions=2,
        world=_world(11, None, 100, 20),
    ),
    "thesis": Profile(
        image_size=320,
        base_filters=64,
        batch_size=16,
        learning_rate=0.001,
        threads=8,
        epochs=100,
        patience=5,
        training_images=None,
        frames=None,
        timed_frames=200,
        widths=ALL_WIDTHS,
        repetitions=5,
        world=_world(11, 300, 2975, 500),
    ),
}
SEED = 0


@dataclass(frozen=True)
class Settings:
    """Settings of one run.

    `run` names its data and sizes, so that runs with other settings use other folders.
    """

    profile: str
    sizes: Profile
    kitti: Path  # the user's KITTI folder, or the one of the embedded world
    cityscapes: Path
    kitti_is_embedded: bool
    cityscapes_is_embedded: bool
    run: str
    build: Path  # folder of all results of this run but its figures and tables
    figures: Path
    world: Path  # folder that the embedded world is written to
    jobs: int
    scheduler: str | None = None  # address of a Dask scheduler
    kitti_semantic: Path | None = None  # the user's folder of KITTI street scenes with label maps
    seed: int = SEED

    @property
    def uses_shipped_model(self) -> bool:
        """Whether the shipped model makes the label maps.

        It does if there are real frames, but no real images to train on.
        """
        return self.cityscapes_is_embedded and not self.kitti_is_embedded

    @property
    def figures_in_git(self) -> bool:
        """Whether the figures folder is the one in git.

        It holds the figures of the default run.
        """
        return self.figures == ROOT / "figures"

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
        return f"run {self.run}; results: {_from_root(self.build)}"


def read_settings(environment: Mapping[str, str] | None = None) -> Settings:
    """Return the settings that the THESIS_REPRO_ variables of an environment give.

    The default is os.environ. Raises InputError for an unknown variable, a data folder that does
    not exist, and a bad number.
    """
    values = _values(os.environ if environment is None else environment)
    profile = values.get("PROFILE", "demo")
    if profile not in PROFILES:
        raise InputError(f"PROFILE={profile}: unknown profile; choose one of {', '.join(PROFILES)}")
    folders = _data_folders(values)
    for name in {"BUILD", "FIGURES"} & values.keys():
        if re.search(r"[`$\"'\\;&|<>()*?\[\]{}!\n]", values[name]):  # make passes them to a shell
            raise InputError(f"{name}={values[name]}: has a character that shells treat specially")
        check_outside(f"{name}={values[name]}", Path(values[name]), folders.values())
    build = Path(values.get("BUILD", ROOT / "build")).absolute()
    figures = Path(values.get("FIGURES", ROOT / "figures")).absolute()
    world = build / f"world-{profile}"
    sizes = _sizes(profile, values)
    run = _run_name(folders, profile, sizes)
    if run != "embedded-demo":
        # figures/ holds the figures of the default run; every other run gets a folder in it
        figures /= run
    return Settings(
        profile=profile,
        sizes=sizes,
        kitti=folders.get("KITTI", world / "kitti"),
        cityscapes=folders.get("CITYSCAPES", world / "cityscapes"),
        kitti_is_embedded="KITTI" not in folders,
        cityscapes_is_embedded="CITYSCAPES" not in folders,
        run=run,
        build=build / run,
        figures=figures,
        world=world,
        jobs=number("JOBS", values.get("JOBS", str(cores()))),
        scheduler=scheduler_address(values.get("DASK_SCHEDULER")),
        kitti_semantic=folders.get("KITTI_SEMANTIC"),
    )


def _values(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the THESIS_REPRO_ variables that are not empty, by name without this prefix."""
    values = {}
    for variable, value in environment.items():
        if variable.startswith(PREFIX) and value:
            values[variable.removeprefix(PREFIX)] = value
    for name in sorted(values.keys() - set(VARIABLES)):
        raise InputError(f"{PREFIX}{name}: unknown setting; known are {', '.join(VARIABLES)}")
    return values


def _data_folders(values: Mapping[str, str]) -> dict[str, Path]:
    """Return the user's folders of data, by the name of their variable."""
    folders = {}
    for name in ("KITTI", "CITYSCAPES", "KITTI_SEMANTIC"):
        if name not in values:
            continue
        folders[name] = Path(values[name]).expanduser().absolute()
        if not folders[name].is_dir():
            raise InputError(f"{name}={values[name]}: no such folder")
    return folders


def _sizes(profile: str, values: Mapping[str, str]) -> Profile:
    """Return the sizes of a profile, with those replaced that variables give."""
    changed: dict[str, Any] = {}
    for name in SIZES:
        if name not in values:
            continue
        text = values[name]
        if name == "WIDTHS":
            changed["widths"] = read_widths(text)
        elif name == "FRAMES":
            changed["frames"] = read_frames(text)
        else:
            changed[name.lower()] = number(name, text)
    return replace(PROFILES[profile], **changed)


def check_outside(name: str, path: Path, data: Iterable[Path]) -> None:
    """Raise InputError if an output lies in or below one of the paths given as data.

    Data is only read. name: how the user gave the output.
    """
    for folder in data:
        if path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{name}: lies in {folder}, which is data and only read; name another")


def _run_name(folders: dict[str, Path], profile: str, sizes: Profile) -> str:
    """Name of the run: its data, its profile, and the sizes that differ from the profile's."""
    data = [] if folders.keys() & {"KITTI", "CITYSCAPES"} else ["embedded"]
    for name, folder in folders.items():
        # make and shells treat other characters specially
        letters = re.sub(r"[^\w.+-]+", "-", folder.name)
        # for folders of the same name
        path_digest = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:6]
        kind = name.lower().removeprefix("kitti_")
        data.append(f"{kind}-{letters}-{path_digest}")
    parts = ["_".join(data), profile]
    for name, text in _changed_sizes(profile, sizes).items():
        short = text.replace(", ", "_")
        if len(short) > 40:
            short = hashlib.sha256(short.encode()).hexdigest()[:8]
        parts.append(f"{name.replace(' ', '-')}-{short}")
    return "-".join(parts)


def _changed_sizes(profile: str, sizes: Profile) -> dict[str, str]:
    """The sizes that differ from the profile's, as text by name ("image size")."""
    texts = {}
    for size in SIZES:
        field = size.lower()
        value = getattr(sizes, field)
        if value == getattr(PROFILES[profile], field):
            continue
        text = "all"
        if value is not None:
            text = str(value).strip("(),")  # of (5, 10), or of 5
        texts[field.replace("_", " ")] = text
    return texts


def number(name: str, text: str) -> int:
    """Return the whole number in the text of setting `name`.

    Raises InputError if its LIMITS do not allow it.
    """
    least, most, step = LIMITS[name]
    if re.fullmatch("[0-9]{1,19}", text):
        value = int(text)
        if least <= value <= most and value % step == 0:
            return value
    allowed = f"from {least} to {most}"
    if step > 1:
        allowed += f", a multiple of {step}"
    raise InputError(f"{name}={text[:60]}: must be a whole number {allowed}")


def read_frames(text: str) -> int | None:
    """Return the number of frames in a text, or None for "all".

    Raises InputError for a bad number.
    """
    if text == "all":
        return None
    return number("FRAMES", text)


def read_widths(text: str) -> tuple[int, ...]:
    """Return the dilation widths, pixels, in a text such as "1-3,10", sorted.

    Raises InputError for another text.
    """
    least, most, _ = LIMITS["WIDTHS"]
    error = InputError(
        f"WIDTHS={text[:60]}: must be whole numbers from {least} to {most}, such as 5,10 or 1-15"
    )
    widths: set[int] = set()
    for word in text.replace(",", " ").split():
        match = re.fullmatch("([0-9]{1,4})(?:-([0-9]{1,4}))?", word)
        if match is None:
            raise error
        first, last = int(match[1]), int(match[2] or match[1])
        if not least <= first <= last <= most:
            raise error
        widths.update(range(first, last + 1))
    if not widths:
        raise error
    return tuple(sorted(widths))


def scheduler_address(text: str | None) -> str | None:
    """Return the address of a Dask scheduler, or None if there is none.

    Raises InputError for any other text, for which Dask would start a new cluster or read a file.
    """
    if text is not None and not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://\S+:\d{1,5}", text):
        raise InputError(
            f"Dask scheduler {text}: must be tcp://host:port, as 'dask scheduler' prints it"
        )
    return text


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _from_root(path: Path) -> Path:
    if path.is_relative_to(ROOT):
        return path.relative_to(ROOT)
    return path


if __name__ == "__main__":
    # The Makefile calls this: it prints the folder of the run, or with "figures" where the results
    # are.
    try:
        _settings = read_settings()
    except InputError as error:
        sys.exit(f"error: {error}")
    built = _from_root(_settings.build)
    if sys.argv[1:] == ["figures"]:
        page = _from_root(_settings.figures / "index.html")
        print(f"tables and figures: open {page} in a browser; ", end="")
        print(f"executed notebooks: {built / 'notebooks'}")
    else:
        print(built)
