"""Keypoint masks: the thesis's on one page (filter.py), other kinds beside it (kinds.py)."""

from thesis_repro.masks.filter import (
    CANNY,
    WIDTHS,
    canny_edges,
    check_width,
    coverage,
    dilate,
    thesis_mask,
)
from thesis_repro.masks.kinds import (
    BOUNDARIES,
    DYNASLAM_MARGIN,
    KINDS,
    MOVABLE,
    THESIS_MASKS,
    MaskSettings,
    boundaries_found,
    edges,
    exact_edges,
    keypoint_mask,
    near_movable,
)

__all__ = [
    "BOUNDARIES",
    "CANNY",
    "DYNASLAM_MARGIN",
    "KINDS",
    "MOVABLE",
    "THESIS_MASKS",
    "WIDTHS",
    "MaskSettings",
    "boundaries_found",
    "canny_edges",
    "check_width",
    "coverage",
    "dilate",
    "edges",
    "exact_edges",
    "keypoint_mask",
    "near_movable",
    "thesis_mask",
]
