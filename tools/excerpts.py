"""Cut the frames of the evidence from KITTI, as people download it.

`make excerpts KITTI=... RAW=...` writes build/excerpts: links to the frames that
figures/kitti_excerpts/frames.csv names, with their poses, times and cameras. It checks digests of
frames and poses, and says which differ or are missing. Then `make evidence KITTI=build/excerpts`
runs on what the evidence in git was made from.
"""

import sys
from pathlib import Path

import pandas as pd

from thesis import real_frames
from thesis.run_settings import ROOT
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import progress

FOLDER = ROOT / "build" / "excerpts"
RAW_DRIVE = "{date}/{date}_drive_{sequence}_sync"


def opened(street: pd.Series, kitti_root: str, raw_root: str) -> Sequence:
    """Open the whole sequence of a row of the manifest. Raises InputError if it is not there."""
    if street["data"] == "odometry":
        if not kitti_root:
            raise InputError("KITTI: give the folder of KITTI's odometry benchmark")
        return Sequence(kitti_root, street["sequence"], street["camera"])
    if not raw_root:
        raise InputError("RAW: give the folder of KITTI's raw drives, which holds days")
    return Sequence(None, Path(raw_root) / RAW_DRIVE.format(**street), street["camera"])


def cut_streets(kitti_root: str, raw_root: str, folder: Path) -> dict[str, str]:
    """Cut all streets of the manifest, and return what differs or is missing, by street."""
    told = {}
    manifest = real_frames.read_manifest()
    for name, street in progress(list(manifest.iterrows()), "cutting", unit="street"):
        try:
            sequence = opened(street, kitti_root, raw_root)
            made = real_frames.cut(sequence, street["first"], street["last"], folder, name)
        except InputError as error:
            told[name] = f"missing: {error}"
            continue
        parts = real_frames.differences(made, street)
        if parts:
            told[name] = f"other {' and '.join(parts)} than the evidence's ({street['made']})"
    return told


def main(arguments: list[str]) -> int:
    """Write the excerpts. Returns 1 if a street differs or is missing."""
    kitti_root, raw_root = (text and str(ROOT / Path(text).expanduser()) for text in arguments)
    told = cut_streets(kitti_root, raw_root, FOLDER)
    for name, text in told.items():
        program.log.warning(f"{name}: {text}")
    count = len(real_frames.read_manifest())
    program.summary(f"{count - len(told)} of {count} streets are those of the evidence: {FOLDER}")
    return int(bool(told))


if __name__ == "__main__":
    program.run_main(lambda: main(sys.argv[1:]))
