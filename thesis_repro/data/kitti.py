"""The sequences in a folder as KITTI's: their names, and where true label maps are."""

from pathlib import Path

from thesis_repro.data import layout
from thesis_repro.data.geometry import CAMERAS
from thesis_repro.errors import InputError

TRUE_LABELS = "labels_0"  # exact label maps beside image_0, which only the embedded world has


def sequences(root: str | Path) -> list[str]:
    """Names of the sequences with frames and ground truth, in sorted order.

    00 to 10 are listed even without a file of poses, so that `Sequence` reports the missing file.
    Raises InputError if there are none.
    """
    names = [
        name
        for name in with_frames(root)
        if name in CAMERAS or layout.poses(layout.locate(root, name)).exists()
    ]
    if not names:
        raise InputError(
            f"{layout.sequences_folder(root)}: no sequence holds frames and ground truth"
        )
    return names


def with_frames(root: str | Path) -> list[str]:
    """Names of all sequences with frames, in sorted order.

    KITTI publishes no ground truth for 11 to 21. Raises InputError if the folder has another
    layout.
    """
    folder = layout.sequences_folder(root)
    if not folder.is_dir():
        raise InputError(
            f"{root}: must be the folder that holds sequences/NN/image_0 and poses/NN.txt, or folders of "
            "KITTI's raw drives, EuRoC or TUM RGB-D"
        )
    return [path.name for path in layout.folders_with_frames(folder)]
