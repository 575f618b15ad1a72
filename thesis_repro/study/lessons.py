"""What the notebooks hand on: checked knobs, records of what was made from what, and attempts.

Each notebook leaves a **record** in the build folder: what it made, from what, and what was edited
on the way. It takes its old record back when it begins, and writes the new one at its end. So a
notebook that was changed, stopped or left out is noticed by the next one, which says what to run
again. An **attempt** is a row of notebook 8's last table: a run with what was edited.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from math import isfinite
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import LabelMasks, MaskFolder, MaskSettings
from thesis_repro.running import files, results
from thesis_repro.running.settings import LIMITS
from thesis_repro.study.compare import JUDGING_METRICS, SECONDARY_METRICS

# {notebook: the file with its record}, in the order in which they are run
RECORDS = {
    "01_load_images_and_labels": "images.json",
    "02_augmentation": "augmentation.json",
    "03_unet": "network.json",
    "04_training": "training.json",
    "05_prediction": "labels.json",
    "06_keypoint_masks": "masks.json",
    "07_visual_odometry": "odometry.json",
    "08_results": "results.json",
}
MASKS_BY_HAND, PATHS_BY_HAND = "masks_by_hand", "paths_by_hand"  # folders of edited cells' results

# Knobs


def whole(name: str, value: Any, limits: tuple[int, int, int] | None = None) -> None:
    """Raise InputError unless a knob is a whole number.

    limits: least, most, and what it must be a multiple of; by default those of the setting.
    """
    least, most, step = limits or LIMITS[name]
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or not least <= value <= most or value % step:
        allowed = f"from {least} to {most}"
        if step > 1:
            allowed += f", a multiple of {step}"
        raise InputError(f"{name}={value!r:.60}: must be a whole number {allowed}")


def positive(name: str, value: Any) -> None:
    """Raise InputError unless a knob is a number above 0."""
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if not is_number or not isfinite(value) or value <= 0:
        raise InputError(f"{name}={value!r:.60}: must be a number above 0")


def one_of(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise InputError unless a knob is one of the choices."""
    allowed = list(choices)
    if value not in allowed:
        words = ", ".join(map(str, allowed))
        raise InputError(f"{name}={value!r:.60}: choose one of {words}")


def names_of(value: Any, known: list[str]) -> list[str]:
    """Return the sequences that the knob NAMES chooses: all known ones for None, or those listed.

    Raises InputError unless each of the list is known.
    """
    if value is None:
        return known
    if (
        not isinstance(value, (list, tuple))
        or not value
        or not all(each in known for each in value)
    ):
        example = f'["{known[0]}"]'
        raise InputError(
            f"NAMES={value!r:.60}: must be None for all sequences, or a list such as {example}; there "
            f"are {', '.join(known)}"
        )
    return list(value)


def edges_and_mask(made: Any, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges and the mask that a function of the reader's made, uint8 (height, width).

    Booleans become 0 and 255. Raises InputError for anything else than two images of this size and
    kind, and for a mask that holds other values than 0 and 255.
    """
    if not isinstance(made, (tuple, list)) or len(made) != 2:
        raise InputError(
            f"mask_by_hand: returned one value ({type(made).__name__}); return two, edge image and mask"
        )
    images = []
    for name, image in zip(("edge image", "mask"), map(np.asarray, made), strict=True):
        if image.dtype == bool:
            image = np.where(image, np.uint8(255), np.uint8(0))
        if image.dtype != np.uint8 or image.shape != tuple(size):
            raise InputError(
                f"mask_by_hand: its {name} is {image.dtype} of shape {image.shape}; return uint8 or "
                f"bool of shape {tuple(size)}"
            )
        images.append(image)
    values = np.unique(images[1])
    if not np.isin(values, (0, 255)).all():
        raise InputError(
            f"mask_by_hand: its mask holds {len(values)} different values; return 0 and 255"
        )
    return images[0], images[1]


# Records


@dataclass(frozen=True)
class Record:
    """What a notebook left. All values are JSON values.

    made: stands for the files that it left, such as their digest. made_from: {notebook: its `made`}
    of the notebooks whose files it read. edited: {"04, EPOCHS": 3}, what was edited in this
    notebook and in those before it. settings: what the next notebooks need to know.
    """

    made: Any
    made_from: dict[str, Any] = field(default_factory=dict)
    edited: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)


def begin(build: Path, notebook: str, *needed: str) -> dict[str, Record]:
    """Begin a notebook: delete its old record, and return those of the notebooks that it needs.

    Raises InputError as `current` does.
    """
    (build / RECORDS[notebook]).unlink(missing_ok=True)
    return current(build, *needed)


def current(build: Path, *needed: str) -> dict[str, Record]:
    """Return the records of notebooks, {notebook: record}.

    Raises InputError if one was not run to its end, or was run before one that it needs was run
    again with another outcome.
    """
    records = {}
    for notebook in needed:
        record = records[notebook] = _read(build, notebook)
        for earlier, made in record.made_from.items():
            if current(build, earlier)[earlier].made != made:
                raise InputError(
                    f"{build / RECORDS[notebook]}: was made before {earlier} made something else; run "
                    f"{notebook} again"
                )
    return records


def finish(
    build: Path,
    notebook: str,
    used: Mapping[str, Record],
    made: Any,
    edited: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """End a notebook: write its record, and say which edits its files come from.

    used: the records of the notebooks whose files it read, as `begin` returns them. edited: what
    was edited in this notebook.
    """
    edits: dict[str, Any] = {}
    for record in used.values():
        edits |= record.edited
    edits |= {f"{notebook[:2]}, {name}": value for name, value in (edited or {}).items()}
    made_from = {name: record.made for name, record in used.items()}
    record = Record(made, made_from, edits, dict(settings or {}))
    files.write_text(build / RECORDS[notebook], json.dumps(asdict(record), indent=1))
    shown = name_of(edits) if edits else "none"
    print(f"edits behind the files of {notebook}: {shown}")


def of_odometry(build: Path) -> Record:
    """Return the record of notebook 7, or an empty one if it was not run.

    Raises InputError if its paths were made with masks that notebook 6 has replaced.
    """
    notebook = "07_visual_odometry"
    if not (build / RECORDS[notebook]).is_file():
        return Record(None)
    return current(build, notebook)[notebook]


def _read(build: Path, notebook: str) -> Record:
    path = files.needed(build / RECORDS[notebook], notebook)
    try:
        record = Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        record = Record(None, made_from={"": None})
    parts = record.made_from, record.edited, record.settings
    if not all(isinstance(part, dict) for part in parts) or record.made_from.keys() - RECORDS:
        raise InputError(f"{path}: is damaged; run {notebook} again")
    return record


def name_of(edits: Mapping[str, Any]) -> str:
    """Return the name of an attempt, such as "04, EPOCHS=3; 06, your mask"."""
    texts = [name if value is True else f"{name}={value}" for name, value in edits.items()]
    return "; ".join(texts) or "as the thesis's"


def changed(chosen: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the chosen values that differ from the usual ones."""
    return {name: value for name, value in chosen.items() if value != usual[name]}


def digest(made: Any) -> str:
    """Return a short digest of JSON values, which tells attempts of one name apart."""
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()[:4]


def digest_of_folder(folder: Path) -> str:
    """Return a digest of the PNG files in the folders of a folder, one a sequence."""
    return results.digest_of_files(files.listed(folder, "*/*.png"))


def masks_of(build: Path, record: Record, sequence: Sequence) -> LabelMasks | MaskFolder:
    """Return the masks of a sequence as notebook 6 left them: by knobs, or by an edited cell."""
    chosen = record.settings
    if chosen["by_hand"]:
        return MaskFolder(build / MASKS_BY_HAND / sequence.name, sequence)
    folder = files.needed(build / chosen["labels"] / sequence.name, "05_prediction")
    settings = MaskSettings(**chosen["settings"])
    return LabelMasks(folder, sequence, chosen["dilation_width"], settings)


def keep_path(
    build: Path, sequence: Sequence, method: str, seed: int, poses: np.ndarray, keypoints: float
) -> None:
    """Write a path (n, 4, 4) by the edited loop of notebook 7, and its mean number of keypoints."""
    file = build / PATHS_BY_HAND / _name_of_path(sequence, method, seed)
    results.store(file, {"mean_keypoints": keypoints}, {"poses": poses})


def paths_kept(build: Path) -> list[Path]:
    """Return the files that `keep_path` wrote."""
    return files.listed(build / PATHS_BY_HAND, "*.npz")


def path_of(build: Path, sequence: Sequence, method: str, seed: int) -> tuple[np.ndarray, float]:
    """Return what `keep_path` wrote: the poses of the sequence's frames, and the keypoints.

    Raises InputError if there is no such path, or one of fewer frames.
    """
    file = build / PATHS_BY_HAND / _name_of_path(sequence, method, seed)
    stored = results.resume(file)
    if stored is None or len(stored[1]["poses"]) < len(sequence):
        raise InputError(
            f"{file}: no path of {len(sequence)} frames; run 07_visual_odometry again, or take FRAMES "
            "and REPETITIONS of the profile here"
        )
    job, arrays = stored
    return arrays["poses"][: len(sequence)], job["mean_keypoints"]


def _name_of_path(sequence: Sequence, method: str, seed: int) -> str:
    return f"{sequence.name}-{method}-{seed}.npz"


# Attempts

RUN = ["sequence", "method", "repetition"]
# the two errors that decide, and the thesis's
ERRORS = JUDGING_METRICS | {"rmse": SECONDARY_METRICS["rmse"]}
ATTEMPT = ["attempt", "inputs", "frames"]
COLUMNS = [*RUN, *ERRORS, "mean_keypoints"]


def keep_attempts(path: Path, new: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Add attempts to a file, and return all that it holds.

    new: tables with ATTEMPT, COLUMNS and mean_iou. A run that is in the file stays as it is. A file
    of other columns, from another version, is begun anew.
    """
    tables = list(new)
    if path.is_file():
        earlier = pd.read_csv(path, dtype={"sequence": str, "inputs": str})
        if set(earlier) == {*ATTEMPT, *COLUMNS, "mean_iou"}:
            tables.insert(0, earlier)
    attempts = pd.concat(tables).drop_duplicates([*ATTEMPT, *RUN], ignore_index=True)
    files.write_text(path, attempts.to_csv(index=False))
    return attempts


def compare_attempts(attempts: pd.DataFrame) -> pd.DataFrame:
    """Compare attempts with the first one: one row for each attempt and error.

    Each error with masks is divided by that of the first attempt in the same run (sequence and
    repetition). The ratio is the geometric mean over runs; lowest and highest are single runs.
    """
    rows = []
    groups = attempts.groupby(["attempt", "inputs"], sort=False)
    first = None
    for (attempt, inputs), runs in groups:
        of_method = {name: table.set_index(RUN) for name, table in runs.groupby("method")}
        masked = of_method["masked"].droplevel("method")
        first = masked if first is None else first
        for error, name in ERRORS.items():
            ratios = masked[error] / first[error]
            row = {
                "attempt": attempt,
                "inputs": inputs,
                "mean IoU": masked["mean_iou"].mean(),
                "keypoints": masked["mean_keypoints"].mean(),
                "error": name,
                "all keypoints": of_method["baseline"][error].mean(),
                "masks": masked[error].mean(),
                "ratio": np.exp(np.log(ratios).mean()),
                "lowest": ratios.min(),
                "highest": ratios.max(),
                "difference": _difference(ratios),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def _difference(ratios: pd.Series) -> str:
    """Say in words whether the ratios of single runs lie on one side of 1."""
    if (ratios > 1).all():
        return "higher in every run"
    if (ratios < 1).all():
        return "lower in every run"
    if (ratios == 1).all():
        return "the same"
    return "within the spread"
