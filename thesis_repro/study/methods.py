"""What a study compares: one table of methods, and one of errors.

A method chooses the keypoints of a run. A new method is an entry in METHODS, a new error of a path
one in ERRORS (and a number in `runner.path_errors`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import KEEP, MaskSettings
from thesis_repro.odometry.metrics import RELATIVE_LENGTH
from thesis_repro.study import controls
from thesis_repro.study.controls import ControlMasks
from thesis_repro.study.sources import Source


class Method(NamedTuple):
    """A way to choose the keypoints of a run.

    title: in tables and figures. altered: the masks of the source, changed. settings: from the
    source's mask settings to those of the method, for other masks from the same label maps.
    has_masks: whether keypoints are found inside a mask. is_control: a control without
    segmentation, which keeps as many keypoints as the masks do but knows nothing of the classes.
    is_compared: in `compare.comparisons`.
    """

    title: str
    altered: type[controls.OtherFrame] | None = None
    settings: Callable[[MaskSettings], MaskSettings] | None = None
    has_masks: bool = True
    is_control: bool = False
    is_compared: bool = True


def _corrected(settings: MaskSettings) -> MaskSettings:
    return replace(controls.CORRECTED, ids=settings.ids)


def _keeping(keep: str) -> Callable[[MaskSettings], MaskSettings]:
    return partial(replace, keep=keep)


METHODS = {  # in the order in which they are shown
    "baseline": Method("all keypoints", has_masks=False),
    "masked": Method("masks"),
    "exact-boundaries": Method(
        "exact class boundaries", settings=partial(replace, boundaries="exact")
    ),
    "corrected": Method("corrected mask", settings=_corrected),
    # as SLAM systems use a segmentation, see masks.KEEP
    "static-boundaries": Method(
        "boundaries of static things", settings=_keeping("static-boundaries")
    ),
    "static": Method("all but movable things", settings=_keeping("static")),
    "inverse": Method("all but the boundaries", settings=_keeping("inverse")),
    "true-labels": Method("true label maps", settings=partial(replace, ids="labels")),
    "other-frame": Method("mask of another frame", controls.OtherFrame, is_control=True),
    "mirrored": Method("mirrored mask", controls.Mirrored, is_control=True),
    "random-lines": Method("random lines", controls.RandomLines, is_control=True),
    "image-edges": Method("edges of the image", controls.ImageEdges, is_control=True),
    "fewer": Method("fewer keypoints", has_masks=False, is_control=True),
    "spread": Method("keypoints spread out", has_masks=False, is_control=True),
    "reduced": Method("reduced keypoints", has_masks=False, is_compared=False),  # Figure 4.12
}
OF_LABEL_MAPS = ("exact-boundaries", "corrected", *KEEP[1:], "true-labels")
# the methods with masks beside "masked", in the order of their runs
MASK_CONTROLS = ("other-frame", "mirrored", "random-lines", "image-edges", *OF_LABEL_MAPS)


def masks_of_method(
    name: str, source: Source, sequence: Sequence, dilation_width: int | None
) -> ControlMasks:
    """Return the masks of a sequence for a method that has masks.

    source: of the masks that a control is compared with. dilation_width: pixels, for masks from
    label maps.
    """
    method = METHODS[name]
    if method.altered:
        return method.altered(source, sequence, dilation_width)
    if method.settings:
        source = replace(source, settings=method.settings(source.settings))
    if name == "true-labels":
        source = replace(source, folder=controls.true_labels(sequence.root, sequence.name))
    return source.masks(sequence, dilation_width)


class Error(NamedTuple):
    """An error of a path. title, unit: in tables and figures. decides: whether masks help."""

    title: str
    unit: str
    decides: bool = False


# The deciding errors are those that a constant angle between camera and ground truth leaves alone.
ERRORS = {
    "se3": Error("aligned ATE", "m", decides=True),
    "rotation": Error("rotation error a frame", "deg", decides=True),
    "rmse": Error("RMSE", "m"),
    "mae": Error("MAE", "m"),
    "translation_percent": Error(f"translation error over {RELATIVE_LENGTH:g} m", "%"),
    "rotation_deg_per_100m": Error(f"rotation error over {RELATIVE_LENGTH:g} m", "deg/100 m"),
    "t_rel": Error("KITTI's t_rel", "%"),
    "r_rel": Error("KITTI's r_rel", "deg/100 m"),
}
