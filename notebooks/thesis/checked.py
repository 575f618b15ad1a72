"""The check of the data of a run, before its notebooks."""

from itertools import chain
from pathlib import Path

from thesis import excerpts
from thesis.settings import Settings
from thesis_repro.checks import report
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.running import files


def check(settings: Settings) -> bool:
    """Check the data of a run, unless it was checked before, and return whether it is sound.

    The names, sizes and times of the files are written beside the results, and again if they have
    changed: then the notebooks are executed again. Raises InputError if a file is missing.
    """
    for name, first, last in settings.ranges:
        excerpts.cut(Sequence(settings.whole, name), first, last, settings.kitti, name)
    path = settings.build / "checked"
    kitti_root = None if settings.kitti_is_embedded else settings.kitti
    cityscapes_root = None if settings.cityscapes_is_embedded else settings.cityscapes
    used: list[Path] = []
    for name in kitti.sequences(kitti_root) if kitti_root else ():
        used += Sequence(kitti_root, name).subset(settings.sizes.frames).files
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
        return True
    sound = report(kitti_root, cityscapes_root, settings.kitti_semantic)
    if sound:
        files.write_text(path, checked)
    return sound
