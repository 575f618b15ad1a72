"""How much label maps flicker from frame to frame: the thesis blames its errors on it (Section 5.1)."""

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError, files

CONSISTENT = 1.0  # pixels; forward and backward flow must cancel to this, or the pixel is left out


def flicker(label_maps, frames):
    """The share of pixels whose class changes between consecutive frames, after the motion has been taken out.

    label_maps: (h, w) uint8 each, any size; frames: (height, width) uint8 each, as many. Returns a DataFrame with a
    row for each pair of frames: `frame` (the later one), `changed` and `compared`, both shares from 0 to 1.

    The embedded world knows its camera's motion, but the displacement of a pixel needs its depth too, and that of a
    moving car its speed. So the displacement is measured: dense optical flow both ways, and only pixels whose two
    flows cancel are compared, which drops what is occluded, enters or leaves. Run on the exact label maps of the
    embedded world it gives the floor of the measure: flow that is off by a pixel at a boundary.

    Raises InputError for fewer than two frames or another number of label maps.
    """
    if len(frames) != len(label_maps) or len(frames) < 2:
        raise InputError(f"flicker: {len(label_maps)} label maps for {len(frames)} frames; it needs at least two "
                         "frames and a label map for each")
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    rows, before = [], None
    for number in files.progress(range(len(frames)), "flicker"):
        frame = np.ascontiguousarray(frames[number])
        label_map = cv2.resize(label_maps[number], frame.shape[::-1], interpolation=cv2.INTER_NEAREST)
        if before is not None:
            backward = flow.calc(frame, before[0], None)
            forward = flow.calc(before[0], frame, None)
            rows.append((number, *_compare(before[1], label_map, forward, backward)))
        before = frame, label_map
    return pd.DataFrame(rows, columns=["frame", "changed", "compared"])


def _compare(old, new, forward, backward):
    height, width = new.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    came_from = columns + backward[..., 0], rows + backward[..., 1]
    there = cv2.remap(forward, *came_from, cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
    with np.errstate(invalid="ignore"):
        compared = np.linalg.norm(there + backward, axis=-1) <= CONSISTENT
    warped = cv2.remap(old, *came_from, cv2.INTER_NEAREST)
    changed = (warped != new) & compared
    return changed.sum() / max(compared.sum(), 1), compared.mean()
