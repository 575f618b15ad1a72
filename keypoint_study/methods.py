"""What is compared: one table of ways to choose keypoints, METHODS.

Studies, tables of few keypoints and ablations select from it. Beside all keypoints and masks, there
are *controls*: masks and settings that leave as many keypoints as the masks of the segmentation,
chosen differently. If the odometry gains as much from a control, the segmentation is not what
helps. A new method is a function and an entry in METHODS.
"""

from collections.abc import Callable, Mapping
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
FILL = 5  # keypoints in each of 16 x 5 fields of the frame, for masks that are filled
# All corrections together. No error was used to choose them: a label map of 320 columns places a
# boundary within about 2 pixels of the frame, and within 10 pixels of its border the Lucas-Kanade
# window of 21 pixels is cut off.
CORRECTED = MaskSettings("exact", symmetric=True, movable=2, margin=10)


# The methods: functions of what is asked

Choice: TypeAlias = tuple[OdometrySettings, Any]  # settings and masks of a run, or None


class Asked(NamedTuple):
    """What a method chooses for.

    width: pixels, of masks that have one, and of lines. number: of keypoints, 0 for no limit.
    """

    sequence: Sequence
    source: Source
    width: int = CONTROL_WIDTH
    number: int = 0


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
        if asked.number:
            settings = replace(settings, max_keypoints=asked.number)
        return settings, masks

    return limited


def drawn(asked: Asked) -> Choice:
    """Run with as many random keypoints as are asked for."""
    return THESIS, MadeMasks(ablations.random_keypoints, asked.sequence, (asked.number,))


def spread_out(asked: Asked) -> Choice:
    """Run with keypoints that are spread over the frame."""
    return replace(THESIS, detector=spread(asked.number)), None


def drawn_on_masks(asked: Asked) -> Choice:
    """Run with random keypoints of those on the masks, as many as are asked for."""
    values = asked.sequence, asked.number
    return THESIS, MadeMasks(ablations.random_keypoints_on, masked(asked)[1], values)


def altered(make: Callable, *values: Any) -> Callable[[Asked], Choice]:
    """Return a method with masks that a function makes from those of the source."""
    return lambda asked: (THESIS, MadeMasks(make, masked(asked)[1], values))


def random_lines(asked: Asked) -> Choice:
    """Run with random lines as wide as those of masks."""
    return altered(controls.random_lines, asked.width)(asked)


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


# The table


class Method(NamedTuple):
    """A way to choose the keypoints of a run.

    title: in tables and figures. group: who compares it. BROUGHT: every study. LABEL_MAPS and
    CONTROL: studies with controls; the first are other masks from a user's label maps, the second
    know nothing of the classes in the frame and keep as many pixels or keypoints as the masks do.
    FEW, ABLATION, CHAPTER_4: the notebooks. choose: from what is asked to the settings and masks of
    a run; its own settings win over those of a study. numbered: whether its jobs say how many
    keypoints, or how far apart they are.
    """

    title: str
    group: str
    choose: Callable[[Asked], Choice]
    numbered: bool = False


BROUGHT, LABEL_MAPS, CONTROL = "brought", "label maps", "control"
FEW, ABLATION, CHAPTER_4 = "few keypoints", "ablation", "chapter 4"
METHODS = {  # in the order in which they are shown
    "baseline": Method("all keypoints", BROUGHT, all_keypoints),
    "masked": Method("masks", BROUGHT, masked),
    # as sources.KINDS has it
    "keypoints": Method("own keypoints", BROUGHT, all_keypoints),
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
    "random-lines": Method("random lines", CONTROL, random_lines),
    "image-edges": Method("edges of the image", CONTROL, image_edges),
    "fewer": Method("fewer keypoints", CONTROL, strongest(all_keypoints), numbered=True),
    "spread": Method("keypoints spread out", CONTROL, all_keypoints, numbered=True),
    # Figure 4.12
    "reduced": Method("reduced keypoints", CHAPTER_4, strongest(all_keypoints), numbered=True),
    "strongest": Method("the strongest", FEW, strongest(all_keypoints), numbered=True),
    "random": Method("random ones", FEW, drawn, numbered=True),
    "spread-anywhere": Method("spread over the frame", FEW, spread_out, numbered=True),
    "strongest-on": Method("the strongest on the mask", FEW, strongest(masked), numbered=True),
    "random-on": Method("random ones on the mask", FEW, drawn_on_masks, numbered=True),
    "filled": Method(f"mask, filled to {FILL} a field", FEW, found_by(filled(FILL), masked)),
    "filter": Method("dropped off the mask", ABLATION, found_by(filtered, masked)),
    "symmetric": Method("symmetric dilation", ABLATION, with_masks(symmetric=True)),
    "no-vegetation": Method("all but vegetation", ABLATION, altered(ablations.without_vegetation)),
    "dropout": Method("nine tenths", ABLATION, of_sequence(ablations.random_keypoints, 0.9)),
    # pixels of parallax that are kept: the first two leave out distant points, the last near ones
    "parallax-1": Method("1 or more", ABLATION, of_sequence(ablations.with_parallax, 1, np.inf)),
    "as many as parallax-1": Method("as many", ABLATION, of_sequence(ablations.as_many, 1, np.inf)),
    "parallax-3": Method("3 or more", ABLATION, of_sequence(ablations.with_parallax, 3, np.inf)),
    "as many as parallax-3": Method("as many", ABLATION, of_sequence(ablations.as_many, 3, np.inf)),
    "parallax-20": Method("below 20", ABLATION, of_sequence(ablations.with_parallax, 0, 20)),
    "as many as parallax-20": Method("as many", ABLATION, of_sequence(ablations.as_many, 0, 20)),
    "turned-into": Method("half turned into", ABLATION, of_sequence(ablations.half_in_turns, True)),
    "turned-from": Method(
        "half turned from", ABLATION, of_sequence(ablations.half_in_turns, False)
    ),
    "orb": Method("ORB", ABLATION, found_by(orb, all_keypoints)),
    "held": Method("masks held", ABLATION, altered(ablations.earlier_mask, True)),
    "jumping": Method("masks that jump", ABLATION, altered(ablations.earlier_mask, False)),
}
# the methods with masks beside "masked", which the tested width of a study is for
MASK_CONTROLS = [
    name
    for name, method in METHODS.items()
    if method.group in (LABEL_MAPS, CONTROL) and not method.numbered
]


def of_group(group: str) -> list[str]:
    """Return the names of the methods of a group."""
    return [name for name, method in METHODS.items() if method.group == group]
