"""The check of the data of a run, before its notebooks: what the Makefile asks for."""

import sys
from itertools import chain
from pathlib import Path

from thesis.settings import read_settings
from thesis_repro.checks import report
from thesis_repro.data import cityscapes, kitti
from thesis_repro.running import files, program


def main(path: Path) -> int:
    """Check the data that the environment's settings name, unless it was checked before.

    path: file with the names, sizes and times of the files that were checked; it is written after a
    check without problems. Returns the exit code. Raises InputError if a file is missing.
    """
    settings = read_settings()
    kitti_root = None if settings.kitti_is_embedded else settings.kitti
    cityscapes_root = None if settings.cityscapes_is_embedded else settings.cityscapes
    used: list[Path] = []
    for name in kitti.sequences(kitti_root) if kitti_root else ():
        used += kitti.Sequence(kitti_root, name).subset(settings.sizes.frames).files
    splits = (
        (cityscapes_root, "train"),
        (cityscapes_root, "val"),
        (settings.kitti_semantic, "train"),
    )
    for root, split in splits:
        used += chain(*[pair[1:] for pair in cityscapes.pairs(root, split)]) if root else ()
    lines = [f"{file} {file.stat().st_size} {file.stat().st_mtime_ns}\n" for file in used]
    checked = ascii("".join(lines))  # names may hold any bytes
    if path.is_file() and path.read_text(encoding="utf-8") == checked:
        return 0
    if not report(kitti_root, cityscapes_root, settings.kitti_semantic):
        return 1
    files.write_text(path, checked)
    return 0


if __name__ == "__main__":
    program.run_main(lambda: main(Path(sys.argv[1])))
