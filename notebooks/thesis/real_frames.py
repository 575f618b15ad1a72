"""Excerpts of sequences: which frames the evidence was made from, and roots that hold such frames.

`figures/kitti_excerpts/frames.csv` is the manifest of the evidence: one row a street.
"""

import hashlib
import os
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from thesis.run_settings import ROOT, Settings
from thesis_repro.data import kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import provenance
from thesis_repro.running.files import write_text

FOLDER = ROOT / "figures" / "kitti_excerpts"  # of the evidence in git
MANIFEST = FOLDER / "frames.csv"
DECIMALS = 7  # of poses in a digest, metres: processors differ by up to 6e-14 m


def read_manifest() -> pd.DataFrame:
    """Return the manifest by street: data set, camera, frames from first to last, digests."""
    return pd.read_csv(MANIFEST, dtype={"street": str, "sequence": str}).set_index("street")


def digests(sequence: Sequence) -> dict[str, str]:
    """Return the SHA-256 of a sequence's decoded gray frames, and that of its poses.

    Frames are hashed row by row, one after the other; poses as 12 numbers each, rounded.
    """
    frames = hashlib.sha256()
    for frame in sequence:
        frames.update(frame.tobytes())
    poses = np.round(sequence.poses[:, :3], DECIMALS) + 0.0  # zero has one sign
    return {"frames": frames.hexdigest(), "poses": hashlib.sha256(poses.tobytes()).hexdigest()}


def differences(sequence: Sequence, street: pd.Series) -> list[str]:
    """Return which of "frames" and "poses" differ from a row of the manifest."""
    if len(sequence) != street["last"] - street["first"] + 1:
        return ["frames", "poses"]
    return [part for part, digest in digests(sequence).items() if digest != street[part]]


def is_evidence(settings: Settings) -> bool:
    """Whether a run has the frames and sizes of the evidence in git."""
    if settings.kitti_is_embedded or not settings.run.endswith("-thesis"):
        return False
    return are_those_of_the_evidence(settings.kitti)


@cache
def are_those_of_the_evidence(root: Path) -> bool:
    """Whether a folder's sequences are the manifest's, frame by frame and pose by pose."""
    manifest = read_manifest()
    sequences = [Sequence(root, name) for name in kitti.sequences(root)]
    if [sequence.name for sequence in sequences] != list(manifest.index):
        return False
    lengths = manifest["last"] - manifest["first"] + 1
    if list(map(len, sequences)) != list(lengths):  # decodes nothing
        return False
    return not any(differences(each, manifest.loc[each.name]) for each in sequences)


def cut(
    sequence: Sequence, first: int, last: int, root: Path, name: str, every: int = 1
) -> Sequence:
    """Write some frames of a sequence as a sequence of a root in KITTI's layout, and return it.

    first, last: numbers of frames, from 0 on, the last one included. every: 2 takes every second of
    them. Frames are links; poses, times
    and camera have seven digits, as KITTI's own files. Raises InputError if frames are missing, or
    if the camera has distortion.
    """
    kept = slice(first, last + 1, every)
    frames = sequence.frame_paths[kept]
    if len(frames) != len(range(first, last + 1, every)):
        raise InputError(
            f"{sequence.folder}: has {len(sequence)} frames; {first} to {last} are wanted"
        )
    if sequence.lens.distortion.any():
        raise InputError(f"{sequence.folder}: has distortion; only KITTI's frames are cut")
    folder = root / "sequences" / name
    projection = np.column_stack([sequence.intrinsics, np.zeros(3)])
    poses = sequence.poses[kept, :3].reshape(-1, 12)
    texts = {
        folder / "calib.txt": "P0: " + _lines([projection.ravel()]),
        folder / "times.txt": _lines(sequence.times[kept, None]),
        root / "poses" / f"{name}.txt": _lines(poses),
    }
    links = {folder / "image_0" / frame.name: str(frame.resolve()) for frame in frames}
    with provenance.claimed(folder):
        for path in set(folder.glob("image_0/*")) - links.keys():
            path.unlink()
        for path, target in links.items():
            if not path.is_symlink() or os.readlink(path) != target:
                path.parent.mkdir(exist_ok=True)
                path.unlink(missing_ok=True)
                os.symlink(target, path)
        for path, text in texts.items():  # what has not changed keeps its time
            if not path.is_file() or path.read_text(encoding="utf-8") != text:
                write_text(path, text)
    return Sequence(root, name)


def _lines(rows: Iterable) -> str:
    return "".join(" ".join(f"{number:.6e}" for number in row) + "\n" for row in rows)
