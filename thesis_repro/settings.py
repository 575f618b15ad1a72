"""Where the data is, how big the run is and where results go: read once from the environment.

Every variable starts with THESIS_REPRO_; `make figures KITTI=... CITYSCAPES=... PROFILE=...` sets them.
"""

import hashlib
import os
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from thesis_repro import InputError

ROOT = Path(__file__).resolve().parent.parent
PREFIX = "THESIS_REPRO_"
# the least and the most that each number may be, and what it must be a multiple of
LIMITS = {"IMAGE_SIZE": (32, 4096, 16), "BASE_FILTERS": (1, 1024, 1), "BATCH_SIZE": (1, 4096, 1),
          "EPOCHS": (1, 100_000, 1), "FRAMES": (5, 10**7, 1), "WIDTHS": (1, 1000, 1), "REPETITIONS": (1, 1000, 1),
          "JOBS": (1, 1024, 1)}
MOST_REPETITIONS = LIMITS["REPETITIONS"][1]
SIZES = tuple(name for name in LIMITS if name != "JOBS")  # of a profile, to be changed one by one
# (PROGRESS: the file or terminal that progress bars are written to; the others are fields of Settings)
VARIABLES = ("PROFILE", "KITTI", "CITYSCAPES", "KITTI_SEMANTIC", "BUILD", "FIGURES", "DASK_SCHEDULER", "PROGRESS",
             *LIMITS)
ALL_WIDTHS = tuple(range(1, 16))


@dataclass(frozen=True)
class Profile:
    """Sizes of a run; None stands for everything there is. Code paths never depend on the profile."""

    image_size: int  # pixels, both ways, of the network's input
    base_filters: int  # channels of the U-Net's first block
    batch_size: int
    learning_rate: float  # of Adam
    threads: int  # inside an operation of the training: part of its bits, so that no number of cores changes them
    epochs: int
    patience: int  # epochs without a lower validation loss before training stops
    training_images: int | None  # images taken from the training split
    frames: int | None  # frames taken from the start of each sequence
    timed_frames: int  # frames from the start of each sequence on which the cost of each width is timed
    widths: tuple  # dilation widths, pixels
    repetitions: int  # of each run, each with the matched points shuffled in another way
    # the embedded world
    world_sequences: int
    world_frames: int | None  # of each sequence; None for as many as show all of its drive, 41 to 132
    world_training_images: int
    world_validation_images: int

    @property
    def world(self):
        """The sizes of the embedded world, as `world.write` takes them."""
        return {"sequences": tuple(f"{number:02d}" for number in range(self.world_sequences)),
                "frames": self.world_frames,
                "train_images": self.world_training_images, "validation_images": self.world_validation_images}


PROFILES = {
    "smoke": Profile(image_size=64, base_filters=4, batch_size=4, learning_rate=0.001, threads=1, epochs=2,
                     patience=5, training_images=16, frames=12, timed_frames=5, widths=(1, 5, 10, 15), repetitions=2,
                     world_sequences=2, world_frames=12, world_training_images=12, world_validation_images=4),
    # For a course: a minute a notebook on two cores, and one drive that bends.
    "lab": Profile(image_size=128, base_filters=8, batch_size=2, learning_rate=0.004, threads=1, epochs=6, patience=5,
                   training_images=60, frames=40, timed_frames=5, widths=(1, 5, 10, 15), repetitions=2,
                   world_sequences=1, world_frames=40, world_training_images=60, world_validation_images=12),
    # The thesis's loss wants many steps: small batches and a higher rate come further in the same minutes.
    "demo": Profile(image_size=128, base_filters=8, batch_size=2, learning_rate=0.004, threads=1, epochs=16,
                    patience=5, training_images=200, frames=200, timed_frames=5, widths=ALL_WIDTHS, repetitions=2,
                    world_sequences=11, world_frames=None, world_training_images=100, world_validation_images=20),
    "thesis": Profile(image_size=320, base_filters=64, batch_size=16, learning_rate=0.001, threads=8, epochs=100,
                      patience=5, training_images=None, frames=None, timed_frames=200, widths=ALL_WIDTHS, repetitions=5,
                      world_sequences=11, world_frames=300, world_training_images=2975, world_validation_images=500),
}
SEED = 0


@dataclass(frozen=True)
class Settings:
    """The settings in force. `run` names the data and the profile; results of different runs never meet."""

    profile: str
    sizes: Profile
    kitti: Path  # the user's folder, or the embedded world's
    cityscapes: Path
    kitti_is_embedded: bool
    cityscapes_is_embedded: bool
    run: str
    build: Path  # results of this run that are not figures
    figures: Path
    world: Path  # where the embedded world is written
    jobs: int
    scheduler: str | None = None  # of a Dask cluster
    kitti_semantic: Path | None = None  # the user's street scenes of KITTI with label maps
    seed: int = SEED

    @property
    def shipped(self):
        """Whether the label maps come from the model in the package: with real frames and nothing to train on."""
        return self.cityscapes_is_embedded and not self.kitti_is_embedded

    @property
    def figures_in_git(self):
        """Whether the figures are those of the default run, which a clone brings along."""
        return self.figures == ROOT / "figures"

    @property
    def data_note(self):
        """One line for captions: which data the numbers come from."""
        odometry = "embedded world (rendered)" if self.kitti_is_embedded else "the user's KITTI folder"
        labels = ("label maps: by the model in the package, no training" if self.shipped else
                  "training: embedded world (rendered)" if self.cityscapes_is_embedded else
                  "training: the user's Cityscapes folder")
        sizes = "".join(f", {name.replace('_', ' ')} {_as_text(value)}"
                        for name, value in _changed(self.profile, self.sizes).items())
        return f"odometry: {odometry}; {labels}; profile {self.profile}{sizes}"

    def __str__(self):
        return f"run {self.run}; results: {_from_root(self.build)}"


def read_settings(environment=None):
    """The settings from the environment's THESIS_REPRO_ variables.

    Sizes that are not the profile's are part of the run's name. Raises InputError for what is unknown, for a missing
    data folder and for a bad number.
    """
    environment = os.environ if environment is None else environment
    given = {name[len(PREFIX):]: value for name, value in environment.items() if name.startswith(PREFIX) and value}
    for name in sorted(given.keys() - set(VARIABLES)):
        raise InputError(f"{PREFIX}{name}: unknown setting; known are {', '.join(VARIABLES)}")
    profile = given.get("PROFILE", "demo")
    if profile not in PROFILES:
        raise InputError(f"PROFILE={profile}: unknown profile; choose one of {', '.join(PROFILES)}")
    build = Path(given.get("BUILD", ROOT / "build")).absolute()
    figures = Path(given.get("FIGURES", ROOT / "figures")).absolute()
    world = build / f"world-{profile}"
    folders = {name: _data_folder(name, given[name])
               for name in ("KITTI", "CITYSCAPES", "KITTI_SEMANTIC") if name in given}
    own_forms = {"WIDTHS": widths, "FRAMES": frames}
    sizes = replace(PROFILES[profile], **{
        name.lower(): own_forms[name](text) if name in own_forms else number(name, text)
        for name, text in given.items() if name in SIZES})
    data = [_short_name(name.lower().removeprefix("kitti_"), path) for name, path in folders.items()]
    whose = ["embedded"] if folders.keys() <= {"KITTI_SEMANTIC"} else []
    run = "-".join(["_".join(whose + data), profile, *(f"{name.replace('_', '-')}-{_in_a_name(value)}"
                                                       for name, value in _changed(profile, sizes).items())])
    return Settings(
        profile=profile, sizes=sizes, kitti=folders.get("KITTI", world / "kitti"),
        cityscapes=folders.get("CITYSCAPES", world / "cityscapes"), kitti_is_embedded="KITTI" not in folders,
        cityscapes_is_embedded="CITYSCAPES" not in folders, run=run, build=build / run,
        # the default run's figures are what visitors see; those of all others go into folders beside them
        figures=figures if run == "embedded-demo" else figures / run,
        world=world, jobs=processes(given.get("JOBS", str(cores()))), kitti_semantic=folders.get("KITTI_SEMANTIC"),
        scheduler=scheduler_address(given.get("DASK_SCHEDULER")))


def number(name, text):
    """The whole number that the setting `name` is given as text. Raises InputError for anything else."""
    least, most, step = LIMITS[name]
    value = int(text) if re.fullmatch("[0-9]{1,19}", text) else -1
    if not least <= value <= most or value % step:
        multiple = f", a multiple of {step}" if step > 1 else ""
        raise InputError(f"{name}={text[:60]}: must be a whole number from {least} to {most}{multiple}")
    return value


def processes(text):
    """The number of processes that a text gives; InputError for no such number."""
    return number("JOBS", text)


def frames(text):
    """How many frames of each sequence a text says: a whole number, or None for "all"."""
    return None if text == "all" else number("FRAMES", text)


def widths(text):
    """The dilation widths, pixels, that a text such as "5,10", "1-15" or "1-3,10" says: a sorted tuple."""
    matches = [re.fullmatch("([0-9]{1,4})(?:-([0-9]{1,4}))?", word) for word in text.replace(",", " ").split()]
    ranges = [range(int(match[1]), int(match[2] or match[1]) + 1) for match in matches if match]
    chosen = sorted({width for of_range in ranges for width in of_range})
    least, most, _ = LIMITS["WIDTHS"]
    if not all(matches) or not all(ranges) or not chosen or chosen[0] < least or chosen[-1] > most:
        raise InputError(f"WIDTHS={text[:60]}: must be whole numbers from {least} to {most}, such as 5,10 or 1-15")
    return tuple(chosen)


def _changed(profile, sizes):
    """The sizes that are not the profile's, by name."""
    own = {name.lower(): getattr(sizes, name.lower()) for name in SIZES}
    return {name: value for name, value in own.items() if value != getattr(PROFILES[profile], name)}


def _as_text(value, between=", "):
    return between.join(map(str, value)) if isinstance(value, tuple) else "all" if value is None else str(value)


def _in_a_name(value):
    text = _as_text(value, "_")
    return text if len(text) <= 40 else hashlib.sha256(text.encode()).hexdigest()[:8]


def scheduler_address(text):
    """The address of a Dask scheduler, or None for none. Raises InputError for anything else: Dask would start a
    cluster of its own or read a file."""
    if text is not None and not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://\S+:\d{1,5}", text):
        raise InputError(f"Dask scheduler {text}: must be tcp://host:port, as 'dask scheduler' prints it")
    return text


def cores():
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _data_folder(name, value):
    path = Path(value).expanduser().absolute()
    if not path.is_dir():
        raise InputError(f"{name}={value}: no such folder")
    return path


def _short_name(name, path):
    # two folders of the same name must not share results
    letters = re.sub(r"[^\w.+-]+", "-", path.name)  # make and shells have their own ideas of others
    return f"{name}-{letters}-{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:6]}"


def _from_root(path):
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else path


if __name__ == "__main__":
    # for the Makefile: the folder of the run, or with "figures" where to look when it is done
    try:
        _settings = read_settings()
    except InputError as error:
        sys.exit(f"error: {error}")
    built, page = _from_root(_settings.build), _from_root(_settings.figures / "index.html")
    print(built if sys.argv[1:] != ["figures"] else
          f"tables and figures: open {page} in a browser; executed notebooks: {built / 'notebooks'}")
