"""A reproduction of a thesis on keypoint masks from semantic segmentation for monocular visual odometry.

What is most needed is here by name: Sequence, keypoint_mask, Odometry, OdometrySettings, THESIS, run, build_unet and
InputError. Each is loaded when it is asked for, so that TensorFlow is, only for build_unet.
"""

from importlib import import_module

_HOMES = {"Sequence": "kitti", "keypoint_mask": "masks", "Odometry": "odometry", "OdometrySettings": "odometry",
          "THESIS": "odometry", "run": "odometry", "build_unet": "segmentation.unet"}

__all__ = ["InputError", *_HOMES]


def one_line(text):
    """A message as one line that a terminal shows as it is: line ends and control characters are spelled out."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode()
                   for letter in str(text))


class InputError(ValueError):
    """Bad input: one line that says what, which file or setting, and what to do about it."""

    def __str__(self):
        return one_line(super().__str__())  # the names of files may hold anything

    def _render_traceback_(self):
        """What IPython shows of it: the line alone."""
        return [f"InputError: {self}"]


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__():
    return [*globals(), *_HOMES]
