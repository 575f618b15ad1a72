"""Where the masks of a study come from: the label maps of a network, or masks ready made; several side by side."""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from thesis_repro import InputError, stages
from thesis_repro.cityscapes import read_label_map
from thesis_repro.files import glance, listed
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks, MaskFolder, MaskSettings, check_mask_size, read_mask

KINDS = {"labels": "label maps", "masks": "masks"}
FileMasks: TypeAlias = LabelMasks | MaskFolder  # both know the `paths` of the files that they read


@dataclass(frozen=True)
class Source:
    """Where masks come from.

    folder: holds one folder a sequence; or, where one sequence is all there is, its files.
    kind: "labels", label maps of any size whose boundaries are dilated; "masks", masks of the frames' size.
    name: that its runs are called by; empty where there is only one source and nobody needs to ask.
    settings: how masks are made from label maps. invert: of masks, keep what they ignore.
    """

    folder: Path
    kind: str = "labels"
    name: str = ""
    settings: MaskSettings = MaskSettings()
    invert: bool = False

    def of(self, sequence: str) -> Path:
        """The folder with the files of one sequence."""
        own = self.folder / sequence
        is_plain = any(self.folder.glob("[!.]*.png"))  # as `thesis-repro predict` and `masks` write them
        return self.folder if not own.is_dir() and is_plain else own

    def masks(self, sequence: Sequence, dilation_width: int | None) -> FileMasks:
        """The masks of a sequence. dilation_width: pixels, of masks from label maps.

        Raises InputError where a frame has no file.
        """
        if self.kind == "masks":
            return MaskFolder(self.of(sequence.name), sequence, self.invert)
        assert dilation_width is not None  # label maps have no masks without one
        return LabelMasks(self.of(sequence.name), sequence, dilation_width, self.settings)

    def check_file(self, path: Path, size: tuple[int, int]) -> None:
        """Raise InputError where a file is no label map, or no mask of a (height, width)."""
        read_label_map(path, self.settings.ids == "train") if self.kind == "labels" else read_mask(path, size)

    def record(self, sequence: str) -> dict[str, str | None]:
        """What tells results of these files and settings from those of others."""
        folder = self.of(sequence)
        made_from = stages.made_from(folder) if stages.record(folder) is not None else None
        settings = {"settings": str(self.settings)} if self.kind == "labels" else {"invert": str(self.invert)}
        return {self.kind: stages.listing(listed(folder)), "made_from": made_from, **settings}


def named(folders: Iterable[tuple[str, Path]], names: Iterable[str], settings: MaskSettings,
          invert: bool = False) -> tuple[Source, ...]:
    """Sources from (kind, folder), the first with the first name; those without one are called as their folder.

    settings: of all masks from label maps. invert: all ready-made masks.
    Raises InputError for a name that cannot be a folder's, for two of the same, and for more names than folders.
    """
    places, given = [(kind, folder.absolute()) for kind, folder in folders], list(names)
    sources: list[Source] = []
    if len(given) > len(places):
        raise InputError(f"--name {given[len(places)]}: {len(given)} names for {len(places)} folders of masks; give "
                         "one --name for each --labels or --masks, in their order")
    for place, (kind, folder) in enumerate(places):
        name = given[place] if place < len(given) else re.sub(r"[^\w+-]+", "-", folder.resolve().name).strip("-")
        if place < len(given) and not re.fullmatch(r"[\w+-]+", name):
            raise InputError(f"--name {name}: a name may have letters, digits, '_', '+' and '-'")
        if name.lower() in (source.name.lower() for source in sources):  # some file systems do not tell case
            raise InputError(f"--name: two folders of masks would be called {name!r}; give each a --name of its own, "
                             "in the order of --labels and --masks")
        sources.append(Source(folder, kind, name or "masks", settings, invert and kind == "masks"))
    return tuple(sources)


def check(sources: Iterable[Source], sequences: Collection[Sequence], widths: Collection[int]) -> None:
    """Raise InputError, before anything runs, where a source does not have what every frame of the sequences needs.

    widths: pixels, of masks from label maps. Of masks the size of every file is looked at; of all sources the first
    file of each sequence is read. (The runner reads all, and what is wrong there costs only the runs that need it.)
    """
    for source in sources:
        what = KINDS[source.kind]
        if not source.folder.is_dir():
            raise InputError(f"{source.folder}: no such folder; it must hold a folder of {what} for each sequence")
        for sequence in sequences:
            if source.of(sequence.name) == source.folder and len(sequences) > 1:
                raise InputError(f"{source.folder}: holds the {what} of one sequence, but {len(sequences)} are asked "
                                 f"for; put them into a folder for each, such as {source.folder / sequence.name}, or "
                                 "name one with --sequences")
            for width in widths or (1,):  # refuses widths that frames of that size cannot have
                paths = source.masks(sequence, width).paths
            if source.kind == "masks":
                for path in paths:
                    check_mask_size(path, glance(path), sequence.size)
            source.check_file(paths[0], sequence.size)
