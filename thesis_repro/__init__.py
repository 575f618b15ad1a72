"""A reproduction of a thesis on keypoint masks from semantic segmentation for monocular visual odometry."""


class InputError(ValueError):
    """Bad input: one line that says what, which file or setting, and what to do about it."""
