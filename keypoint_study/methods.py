"""What is compared: one table of ways to choose keypoints, METHODS.

Studies, tables of few keypoints and ablations select from it. Beside all keypoints and
masks, there are *controls*: masks and settings that leave as many keypoints as the masks of the
segmentation, chosen differently. If the odometry gains as much from a control, the segmentation is
not what helps. A new method is a function and an entry in METHODS.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from keypoint_study import ablations, controls
from keypoint_study.controls import MadeMasks
from keypoint_study.sources import Source
from thesis_repro.data.kitti import TRUE_LABELS
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, OdometrySettings
from thesis_repro.odometry.keypoints import filled, filtered, orb, spread

# Pixels: the dilation width of Section 3.6 and Figures 3.6 and 4.5, at which masks are tested, and
# the width of lines and edges as controls. It was fixed before any run. (The code of appendix A.8
# dilates by 5, audit row 26.)
CONTROL_WIDTH = 10
FEW_SPREAD = 200  # keypoints spread on or off the masks
FILL = 5  # keypoints in each of 16 x 5 fields of the frame, for masks that are filled
# All corrections together. No error was used to choose them: a label map of 320 columns places a
# boundary within about 2 pixels of the frame, and within 10 pixels of its border the Lucas-Kanade
# window of 21 pixels is cut off.
CORRECTED = MaskSettings("exact", symmetric=True, movable=2, margin=10)


# The methods: functions of what is asked

Choice: TypeAlias = tuple[OdometrySettings, Any]  # settings and masks of a run, or None


class Asked(NamedTuple):
    """What a method chooses for.

    width: pixels, of masks that have one, and of lines. number: of keypoints, 0 for no limit; None
    if nobody says.
    """

    sequence: Sequence
    source: Source
    width: int = CONTROL_WIDTH
    number: int | None = None


def all_keypoints(asked: Asked) -> Choice:
    """Run as the thesis does, without masks."""
    return THESIS, None


def masked(asked: Asked) -> Choice:
    """Run with the masks of the source."""
    return THESIS, asked.source.masks(asked.sequence, asked.width)


def strongest(choose: Callable[[Asked], Choice]) -> Callable[[Asked], Choice]:
    """Return a method with the strongest keypoints of another one alone."""

    def limited(asked: Asked) -> Choice:
        settings, masks = choose(asked)
        return (replace(settings, max_keypoints=asked.number) if asked.number else settings), masks

    return limited


def drawn(asked: Asked) -> Choice:
    """Run with as many random keypoints as are asked for."""
    return THESIS, MadeMasks(ablations.random_keypoints, asked.sequence, (asked.number,))


def spread_out(asked: Asked) -> Choice:
    """Run with keypoints that are spread over the frame."""
    return replace(THESIS, detector=spread(asked.number or FEW_SPREAD)), None


def drawn_on_masks(asked: Asked) -> Choice:
    """Run with random keypoints of those on the masks, as many as are asked for."""
    values = asked.sequence, asked.number or FEW_SPREAD
    return THESIS, MadeMasks(ablations.random_keypoints_on, masked(asked)[1], values)


def altered(make: Callable, *values: Any) -> Callable[[Asked], Choice]:
    """Return a method with masks that a function makes from those of the source."""
    return lambda asked: (THESIS, MadeMasks(make, masked(asked)[1], values))


def with_lines(make: Callable) -> Callable[[Asked], Choice]:
    """Return a method with lines of the masks' width, that a function makes from the masks."""
    return lambda asked: altered(make, asked.width)(asked)


def image_edges(asked: Asked) -> Choice:
    """Run with the edges of the frame."""
    return altered(controls.image_edges, asked.sequence, asked.width)(asked)


def of_sequence(make: Callable, *values: Any) -> Callable[[Asked], Choice]:
    """Return a method with masks that a function makes from the sequence."""
    return lambda asked: (THESIS, MadeMasks(make, asked.sequence, values))


def with_masks(settings: MaskSettings | None = None, **changes: Any) -> Callable[[Asked], Choice]:
    """Return a method with other masks from the same label maps.

    settings: of the masks; None: those of the source, with changes.
    """

    def choose(asked: Asked) -> Choice:
        chosen = replace(settings or asked.source.settings, **changes)
        return masked(asked._replace(source=replace(asked.source, settings=chosen)))

    return choose


def from_true_labels(asked: Asked) -> Choice:
    """Run with masks from the true label maps."""
    folder = asked.sequence.folder / TRUE_LABELS
    source = replace(asked.source, folder=folder, ids=LABEL_IDS)
    return masked(asked._replace(source=source))


def found_by(detector: Callable, choose: Callable[[Asked], Choice]) -> Callable[[Asked], Choice]:
    """Return a method with the masks of another one, and a detector of its own."""

    def changed_choice(asked: Asked) -> Choice:
        settings, masks = choose(asked)
        return replace(settings, detector=detector), masks

    return changed_choice


def changed(own: OdometrySettings, changes: Mapping[str, Any]) -> OdometrySettings:
    """Return a method's settings with the changes of a study, but for those that it sets itself.

    A method that fills masks fills what the study's detector finds.
    """
    free = {name for name, value in vars(own).items() if value == getattr(THESIS, name)}
    if isinstance(own.detector, filled) and own.detector.detector is None:
        own = replace(own, detector=replace(own.detector, detector=changes.get("detector")))
    return replace(own, **{name: value for name, value in changes.items() if name in free})


# Where a method is compared, and with how many keypoints

# studies with controls; chapter 4, ablations and few keypoints of the notebooks
STUDY, CHAPTER_4, ABLATIONS, FEW = "study", "chapter 4", "ablations", "few"
# all that it leaves; each number of a list; as many as masks leave
ALL, EACH, AS_MANY = 0, "each", "as many"
IN_STUDY: Mapping[str, Collection] = {STUDY: {ALL}}
ABLATION: Mapping[str, Collection] = {ABLATIONS: {ALL}}


class Method(NamedTuple):
    """A way to choose the keypoints of a run.

    title: in tables and figures. group: REFERENCE, without masks; with the masks BROUGHT by a user,
    or these ALTERED; OWN keypoints or paths of a user; from LABEL_MAPS of the user; a CONTROL
    without segmentation, which keeps as many pixels or keypoints as the masks do but knows nothing
    of the classes; or THESIS_ONLY, for the thesis's figures and the audit. choose: from what is
    asked to the settings and masks of a run. Its own settings win over those of a study. where: in
    what it is compared, with how many keypoints.
    """

    title: str
    group: str
    choose: Callable[[Asked], Choice]
    where: Mapping[str, Collection] = IN_STUDY


REFERENCE, BROUGHT, OWN, ALTERED, LABEL_MAPS, CONTROL, THESIS_ONLY = (
    "reference",
    "brought",
    "own",
    "altered",
    "label maps",
    "control",
    "thesis",
)


def ablation(choose: Callable[[Asked], Choice]) -> Method:
    """Return a method that differs from the thesis in one thing, for the audit."""
    return Method("", THESIS_ONLY, choose, ABLATION)


METHODS = {  # in the order in which they are shown
    "baseline": Method(
        "all keypoints",
        REFERENCE,
        all_keypoints,
        {STUDY: {ALL}, ABLATIONS: {ALL}, FEW: {ALL}},
    ),
    "masked": Method("masks", BROUGHT, masked, {STUDY: {ALL}, ABLATIONS: {ALL}}),
    # these two as sources.KINDS has them
    "keypoints": Method("own keypoints", OWN, all_keypoints),
    "paths": Method("path of another system", OWN, all_keypoints, {STUDY: {ALL}}),
    "filter": ablation(found_by(filtered, masked)),
    "symmetric": ablation(with_masks(symmetric=True)),
    "no-vegetation": ablation(altered(ablations.without_vegetation)),
    "strongest": Method("strongest keypoints", REFERENCE, strongest(all_keypoints), {FEW: {EACH}}),
    "random": Method("random ones", REFERENCE, drawn, {FEW: {EACH}}),
    "spread-anywhere": Method("spread keypoints", REFERENCE, spread_out, {FEW: {EACH}}),
    "strongest-on": Method(
        "strongest on the masks", BROUGHT, strongest(masked), {FEW: {ALL, EACH}}
    ),
    "random-on": Method("random on the masks", BROUGHT, drawn_on_masks, {FEW: {FEW_SPREAD}}),
    "filled": Method("masks, filled", ALTERED, found_by(filled(FILL), masked), {FEW: {ALL}}),
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
    "other-frame": Method("mask of another frame", CONTROL, altered(controls.other_frame)),
    "mirrored": Method("mirrored mask", CONTROL, altered(controls.mirrored)),
    "random-lines": Method("random lines", CONTROL, with_lines(controls.random_lines)),
    "image-edges": Method("edges of the image", CONTROL, image_edges),
    # their jobs say how many keypoints, or how far apart (`runner.keypoint_controls`)
    "fewer": Method("fewer keypoints", CONTROL, strongest(all_keypoints), {STUDY: {AS_MANY}}),
    "spread": Method("keypoints spread out", CONTROL, all_keypoints, {STUDY: {AS_MANY}}),
    "reduced": Method(  # Figure 4.12
        "reduced keypoints", THESIS_ONLY, strongest(all_keypoints), {CHAPTER_4: {AS_MANY}}
    ),
}
# pixels that are kept; the first two leave out distant points, the last near ones
PARALLAX = {"parallax-1": (1, np.inf), "parallax-3": (3, np.inf), "parallax-20": (0, 20)}
METHODS |= {
    "dropout": ablation(of_sequence(ablations.random_keypoints, 0.9)),
    **{
        prefix + name: ablation(of_sequence(make, *span))
        for name, span in PARALLAX.items()
        for prefix, make in (("", ablations.with_parallax), ("as many as ", ablations.as_many))
    },
    "turned-into": ablation(of_sequence(ablations.half_in_turns, True)),
    "turned-from": ablation(of_sequence(ablations.half_in_turns, False)),
    "orb": ablation(found_by(orb, all_keypoints)),
}
# the methods with masks beside "masked", which the tested width of a study is for
MASK_CONTROLS = [
    name
    for name, method in METHODS.items()
    if method.group in (CONTROL, LABEL_MAPS) and AS_MANY not in method.where.get(STUDY, ())
]
AS_SLAM_SYSTEMS = ("static", "inverse", "static-boundaries")


def compared_in(place: str) -> list[str]:
    """Return the names of the methods that are compared in a place."""
    return [name for name, method in METHODS.items() if place in method.where]


def with_numbers(place: str, numbers: Iterable[int]) -> list[tuple[str, int]]:
    """Return (method, number of keypoints) for each number, 0 for no limit, in a place.

    Those that the place has with a number of their own come last.
    """
    asked = {name: METHODS[name].where[place] for name in compared_in(place)}
    each = [
        (name, number)
        for number in numbers
        for name in asked
        if (EACH if number else ALL) in asked[name]
    ]
    own = [(name, number) for name in asked for number in asked[name]]
    return each + [(name, number) for name, number in own if number not in (ALL, EACH, AS_MANY)]
