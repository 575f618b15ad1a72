"""How far an estimated path is from the true one: the thesis's RMSE and MAE (Section 3.4) and the field's measures."""

import numpy as np

from thesis_repro import InputError


def rmse(estimated, true, alignment="position"):
    """Equation 3.5, metres, over frames 1 to n-1 of two (n, 4, 4) paths laid over each other at frame 1."""
    return float(np.sqrt((_differences(estimated, true, alignment) ** 2).sum(axis=1).mean()))


def mae(estimated, true, alignment="position"):
    """Equation 3.6, metres: the mean over x, y, z and frames, laid over each other as in `rmse`."""
    return float(np.abs(_differences(estimated, true, alignment)).mean())


def percent_change(value, benchmark):
    """Equations 4.1 and 4.2: how much larger, in percent, a value is than its benchmark; negative where smaller."""
    return (value - benchmark) / benchmark * 100


def _differences(estimated, true, alignment):
    """(n - 1, 3) position differences from frame 1 on.

    alignment: "position" shifts the estimate so that frame 1 agrees, as PySLAM's 2021 version does; "pose" also turns
    it so that the rotation of frame 1 agrees, as later versions do.
    """
    estimated, true = np.asarray(estimated), np.asarray(true)
    if estimated.shape != true.shape:
        raise InputError(f"the estimated path has {len(estimated)} poses and the true one {len(true)}; "
                         "one pose a frame is needed in both")
    if len(true) < 2:
        raise InputError("a path of one frame has no error; at least 2 frames are needed")
    positions = estimated[1:, :3, 3] - estimated[1, :3, 3]
    if alignment == "pose":
        positions = positions @ (true[1, :3, :3] @ estimated[1, :3, :3].T).T
    return positions - (true[1:, :3, 3] - true[1, :3, 3])
