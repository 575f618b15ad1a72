"""What a study compares: one table of methods.

A method chooses the keypoints of a run. Beside all keypoints and masks, there are *controls*: masks
and settings that leave as many keypoints as the masks of the segmentation, chosen differently. If
the odometry gains as much from a control, the segmentation is not what helps. A new method is a
function and an entry in METHODS, a new error of a path one in path_errors.py.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

from keypoint_study.controls import (
    ImageEdges,
    Mirrored,
    OtherFrame,
    RandomLines,
    WithoutClasses,
    beside,
)
from keypoint_study.sources import Source
from thesis_repro.data.cityscapes import LABELS
from thesis_repro.data.kitti import TRUE_LABELS, Sequence
from thesis_repro.masks import MOVABLE, MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings
from thesis_repro.odometry.keypoints import filtered, spread

# All corrections together. No error was used to choose them: a label map of 320 columns places a
# boundary within about 2 pixels of the frame, and within 10 pixels of its border the Lucas-Kanade
# window of 21 pixels is cut off.
FEW = 200  # keypoints spread on or off the masks
CORRECTED = MaskSettings("exact", symmetric=True, movable=2, margin=10)


# The methods: functions of a sequence, a source and a width of its masks in pixels

Choice: TypeAlias = tuple[OdometrySettings, Any]  # settings and masks of a run, or None


def all_keypoints(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run as the thesis does, without masks."""
    return THESIS, None


def masked(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with the masks of the source."""
    return THESIS, source.masks(sequence, width)


def brought(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with what the source brings in place of the odometry or parts of it."""
    return THESIS, replace(source, folder=source.file(sequence.name))


def altered(masks: type[OtherFrame]) -> Callable[..., Choice]:
    """Return a method with masks that are made from those of the source."""
    return lambda sequence, source, width: (THESIS, masks(source, sequence, width))


def with_masks(settings: MaskSettings | None = None, **changes: Any) -> Callable[..., Choice]:
    """Return a method with other masks from the same label maps.

    settings: of the masks; None: those of the source, with changes.
    """

    def choose(sequence: Sequence, source: Source, width: int | None) -> Choice:
        ids = source.settings.ids
        chosen = replace(settings or source.settings, **{"ids": ids, **changes})
        return masked(sequence, replace(source, settings=chosen), width)

    return choose


def from_true_labels(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with masks from the true label maps."""
    settings = replace(source.settings, ids="labels")
    true = replace(source, folder=sequence.folder / TRUE_LABELS, settings=settings)
    return masked(sequence, true, width)


def changed(own: OdometrySettings, changes: Mapping[str, Any]) -> OdometrySettings:
    """Return a method's settings with the changes of a study, but for those that it sets itself."""
    free = {name for name, value in vars(own).items() if value == getattr(THESIS, name)}
    return replace(own, **{name: value for name, value in changes.items() if name in free})


def found_by(detector: Callable, choose: Callable[..., Choice]) -> Callable[..., Choice]:
    """Return a method with the masks of another one, and a detector of its own."""

    def changed_choice(sequence: Sequence, source: Source, width: int | None) -> Choice:
        settings, masks = choose(sequence, source, width)
        return replace(settings, detector=detector), masks

    return changed_choice


def without(*classes: str) -> Callable[..., Choice]:
    """Return a method with the thesis's keypoints, but those on some classes."""

    def choose(sequence: Sequence, source: Source, width: int | None) -> Choice:
        masks = WithoutClasses(source, sequence, width, classes)
        return replace(THESIS, detector=filtered), masks

    return choose


class Method(NamedTuple):
    """A way to choose the keypoints of a run.

    title: in tables and figures. group: REFERENCE, BROUGHT by the user, from LABEL_MAPS of the
    user, a CONTROL without segmentation, which keeps as many pixels or keypoints as the masks do
    but knows nothing of the classes, or THESIS_ONLY, for a figure of the thesis. choose: from a
    sequence, a source and a width to the settings and masks of a run. Its own settings win over
    those of a study.
    every_study: whether every study with controls runs it; else those that name it (--controls
    NAME). as_many: whether the job says how many keypoints it keeps, as many as the masks.
    """

    title: str
    group: str
    choose: Callable[[Sequence, Source, int | None], Choice]
    every_study: bool = True
    as_many: bool = False


REFERENCE, BROUGHT, LABEL_MAPS, CONTROL, THESIS_ONLY = (
    "reference",
    "brought",
    "label maps",
    "control",
    "thesis",
)
METHODS = {  # in the order in which they are shown
    "baseline": Method("all keypoints", REFERENCE, all_keypoints),
    "masked": Method("masks", BROUGHT, masked),
    "keypoints": Method("own keypoints", BROUGHT, brought),  # these two as sources.KINDS has them
    "paths": Method("path of another system", BROUGHT, brought),
    "exact-boundaries": Method(
        "exact class boundaries", LABEL_MAPS, with_masks(boundaries="exact", keep="boundaries")
    ),
    "corrected": Method("corrected mask", LABEL_MAPS, with_masks(CORRECTED)),
    "static-boundaries": Method(
        "boundaries of static things", LABEL_MAPS, with_masks(keep="static-boundaries")
    ),
    "static": Method("all but movable things", LABEL_MAPS, with_masks(keep="static")),
    "inverse": Method("all but the boundaries", LABEL_MAPS, with_masks(keep="inverse")),
    "true-labels": Method("true label maps", LABEL_MAPS, from_true_labels),
    "other-frame": Method("mask of another frame", CONTROL, altered(OtherFrame)),
    "mirrored": Method("mirrored mask", CONTROL, altered(Mirrored)),
    "random-lines": Method("random lines", CONTROL, altered(RandomLines)),
    "image-edges": Method("edges of the image", CONTROL, altered(ImageEdges)),
    "fewer": Method("fewer keypoints", CONTROL, all_keypoints, as_many=True),
    "spread": Method("keypoints spread out", CONTROL, all_keypoints, as_many=True),
    "reduced": Method("reduced keypoints", THESIS_ONLY, all_keypoints),  # Figure 4.12
}
# Whether it is what lies under the masks, or where in the frame they are: keypoints beside the
# masks, and few that are spread over the frame, on the masks or off them.
IN_PLACE = {
    f"beside-{name}": Method(
        f"beside the {METHODS[name].title}", LABEL_MAPS, found_by(beside, METHODS[name].choose)
    )
    for name in ("masked", "exact-boundaries", "mirrored")
} | {
    f"spread-{where}": Method(
        f"{FEW} spread {words} the masks", LABEL_MAPS, found_by(spread(FEW), METHODS[name].choose)
    )
    for where, words, name in (("on", "over", "masked"), ("off", "off", "inverse"))
}
# which class could be left out
LEFT_OUT = {
    "vegetation": ("vegetation",),
    "road and sidewalk": ("road", "sidewalk"),
    "buildings": ("building", "wall", "fence"),
    "terrain": ("terrain",),
    "poles and signs": ("pole", "traffic sign", "traffic light"),
    "vehicles and people": tuple(LABELS[number].name for number in MOVABLE),
}
EXPLORED = IN_PLACE | {
    f"without-{name.replace(' ', '-')}": Method(f"without {name}", LABEL_MAPS, without(*classes))
    for name, classes in LEFT_OUT.items()
}
METHODS |= {name: method._replace(every_study=False) for name, method in EXPLORED.items()}
AS_SLAM_SYSTEMS = ("static", "inverse", "static-boundaries")
# the methods with masks beside "masked", which the tested width of a study is for
MASK_CONTROLS = [
    name
    for name, method in METHODS.items()
    if method.group in (CONTROL, LABEL_MAPS) and not method.as_many
]
