"""What a user brings to a study: masks or keypoints."""

import re
import runpy
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from traceback import walk_tb
from typing import Any, TypeAlias

import numpy as np

from thesis_repro import odometry
from thesis_repro.data import label_ids
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError, cause
from thesis_repro.masks import MaskSettings
from thesis_repro.masks.folders import LabelMasks, MaskFolder, folder_of_sequence, read_mask
from thesis_repro.odometry import inputs

KINDS = {"labels": "label maps", "masks": "masks", "keypoints": "own keypoints"}
FileMasks: TypeAlias = LabelMasks | MaskFolder  # both have `paths`, the files that they read


@dataclass(frozen=True)
class Source:
    """A source of masks, or of own keypoints.

    folder: holds one folder for each sequence or, for a single sequence, the files themselves.
    kind: "labels" for label maps of any size, whose boundaries are dilated; "masks" for masks of
    the frames' size; "keypoints" for a Python file (`own_calls`) in place of the folder.
    name: used in the names of its runs; empty if there is only one source.
    settings: how masks are made from label maps. invert: swap kept and ignored pixels of ready-made
    masks. ids: what label maps hold, see `LabelMasks`.
    """

    folder: Path
    kind: str = "labels"
    name: str = ""
    settings: MaskSettings = MaskSettings()
    invert: bool = False
    ids: str = LABEL_IDS

    @property
    def has_label_maps(self) -> bool:
        """Whether masks are made from label maps."""
        return self.kind == "labels"

    @property
    def has_width(self) -> bool:
        """Whether its masks have a dilation width."""
        return self.has_label_maps and self.settings.has_width

    def masks(self, sequence: Sequence, dilation_width: int | None) -> FileMasks:
        """Return the masks of a sequence. dilation_width: pixels, for masks with a width.

        Raises InputError if a frame has no file.
        """
        if not self.has_label_maps:
            return MaskFolder(self.folder, sequence, self.invert)
        width = dilation_width if self.has_width else None
        return LabelMasks(self.folder, sequence, width, self.settings, self.ids)

    def run(self, sequence: Sequence, settings: odometry.OdometrySettings) -> odometry.Result:
        """Return the run with own keypoints."""
        calls = own_calls(self.folder)
        own_search = calls.find_essential_matrix is not odometry.OPENCV.find_essential_matrix
        if own_search and hasattr(settings.estimator, "search"):
            raise InputError(
                f"{self.folder}: find_essential_matrix would not be used, because this estimator has a "
                "search of its own; choose another --estimator"
            )
        return odometry.run(sequence, settings, calls=calls)

    @property
    def paths(self) -> list[Path]:
        """The file of keypoints, on which the runs depend."""
        return [self.folder]

    def record(self) -> list[str]:
        """Return what the runs of keypoints depend on beside files."""
        return [self.kind]


@cache
def own_calls(path: Path) -> odometry.Calls:
    """Return the odometry's calls with the functions that a Python file defines in their places.

    Raises InputError for another file, if its code fails, and if it defines none of them. What its
    `detect` and `track` return is checked in every frame.
    """
    if path.suffix != ".py" or path.is_dir():
        raise InputError(
            f"{path}: must be a Python file (.py) with a function detect, track or another of the odometry's "
            "calls; detect may read features that are in files, frame by frame"
        )
    try:
        defined = runpy.run_path(str(path))
    except OSError:
        raise
    except Exception as error:  # of code that a person wrote
        raise InputError(_failed(path, error)) from error
    names = odometry.Calls._fields
    own = {name: _telling(path, defined[name]) for name in names if name in defined}
    if not own:
        raise InputError(f"{path}: must define a function {' or '.join(odometry.Calls._fields)}")
    if "detect" in own:
        own["detect"] = _checked_detect(path, own["detect"])
    if "track" in own:
        own["track"] = _checked_track(path, own["track"])
    return odometry.OPENCV._replace(**own)


def _telling(path: Path, function: Callable) -> Callable:
    """Return a function of a person whose errors name its file and line."""

    def called(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except (InputError, OSError):
            raise
        except Exception as error:
            raise InputError(_failed(path, error)) from error

    return called


def _failed(path: Path, error: Exception) -> str:
    """Return why a person's file failed, with its last line that was executed."""
    lines = [
        number
        for frame, number in walk_tb(error.__traceback__)
        if frame.f_code.co_filename == str(path)
    ]
    return f"{path}{f', line {lines[-1]}' if lines else ''}: {cause(error)}"


def _checked_detect(path: Path, detect: Callable) -> Callable:
    """Return a detector that raises InputError for keypoints that are no (u, v) of the frame."""

    def checked(frame: np.ndarray, settings: Any, mask: np.ndarray | None = None) -> np.ndarray:
        return inputs.keypoints(detect(frame, settings, mask), frame, f"{path}: detect")

    return checked


def _checked_track(path: Path, track: Callable) -> Callable:
    """Return a tracker that raises InputError for anything but points and booleans."""

    def checked(
        previous: np.ndarray, current: np.ndarray, points: np.ndarray, settings: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        try:
            returned = track(previous, current, points, settings)
        except TypeError as error:
            raise InputError(f"{path}: track: {error}") from None
        return inputs.matches(returned, points, f"{path}: track")

    return checked


def _try(path: Path, sequence: Sequence) -> None:
    """Run own keypoints over three frames; raise InputError for whatever their code raises."""
    try:
        odometry.run(sequence.subset(3), calls=own_calls(path))
    except (InputError, OSError):
        raise
    except Exception as error:
        raise InputError(f"{path}: {cause(error)}") from error


def named(
    folders: Iterable[tuple[str, str | None, Path]],
    settings: MaskSettings,
    invert: bool = False,
    ids: str = LABEL_IDS,
) -> tuple[Source, ...]:
    """Return sources from (kind, name, folder). Without a name, that of the folder is used.

    settings, ids: for all masks from label maps; a folder of them may name its own ids, as in
    FOLDER:train. invert: for all ready-made masks.
    Raises InputError for a name that cannot be a folder's name, and for equal names.
    """
    sources: list[Source] = []
    for kind, given_name, folder in folders:
        ids_held = ids
        path, colon, own_ids = str(folder).rpartition(":")
        if colon and kind == "labels" and not folder.is_dir():  # a folder's name may have a colon
            folder, ids_held = Path(path), own_ids
        if given_name is not None and not re.fullmatch(r"[\w+-]+( [\w+-]+)*", given_name):
            raise InputError(
                f"--{kind} {given_name}={folder}: a name has letters, digits, '_', '+', '-' and single "
                "spaces between them"
            )
        folder_name = re.sub(r"[^\w+-]+", "-", folder.resolve().name).strip("-")
        name = given_name or folder_name or "masks"
        # some file systems ignore case
        if name.lower() in [source.name.lower() for source in sources]:
            raise InputError(
                f"--{kind} {folder}: two sources would be called {name!r}; give one another name, "
                f"--{kind} NAME={folder}"
            )
        is_inverted = invert and kind == "masks"
        sources.append(Source(folder.absolute(), kind, name, settings, is_inverted, ids_held))
    return tuple(sources)


def check(
    sources: Iterable[Source], sequences: Collection[Sequence], widths: Collection[int]
) -> None:
    """Raise InputError, before anything runs, if a source lacks files or has files of a wrong kind.

    Each frame needs a file.
    widths: pixels, for masks from label maps. Only the first file of each sequence is read here.
    The runner reads all files, and a bad one stops only the runs that need it.
    """
    for source in sources:
        kind = KINDS[source.kind]
        if source.kind == "keypoints":
            _try(source.folder, next(iter(sequences)))
            continue
        if not source.folder.is_dir():
            raise InputError(
                f"{source.folder}: no such folder; it must hold a folder of {kind} for each sequence"
            )
        for sequence in sequences:
            if (
                len(sequences) > 1
                and folder_of_sequence(source.folder, sequence.name) == source.folder
            ):
                raise InputError(
                    f"{source.folder}: holds the {kind} of one sequence, but {len(sequences)} are "
                    "asked for; put them into a folder for each, such as "
                    f"{source.folder / sequence.name}, or name one with --sequences"
                )
            # raises InputError for a width that is too large for the frames
            for width in widths or (1,):
                paths = source.masks(sequence, width).paths
            if source.has_label_maps:
                label_ids.read(paths[0], source.ids)
            else:
                read_mask(paths[0], sequence.size, source.invert)
