"""A reproduction of a thesis on keypoint masks from semantic segmentation for monocular visual
odometry.

The main names: Sequence, keypoint_mask, LabelMasks, Odometry, OdometrySettings, THESIS, run,
build_unet and InputError. Names are imported on first use, so TensorFlow is loaded only for
build_unet.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Sequence": "kitti",
    "keypoint_mask": "masks",
    "LabelMasks": "masks",
    "Odometry": "odometry",
    "OdometrySettings": "odometry",
    "THESIS": "odometry",
    "run": "odometry",
    "build_unet": "segmentation.unet",
}

__all__ = ["InputError", *_HOMES]


def one_line(text: object) -> str:
    """Return a text as one printable line: line breaks and control characters become escape
    sequences such as \\n.
    """
    return "".join(
        letter
        if letter.isprintable()
        else letter.encode("unicode_escape", "surrogatepass").decode()
        for letter in str(text)
    )


class InputError(ValueError):
    """Bad input. The message is one line that names the file or setting, the problem, and what
    to do.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())  # file names may hold any character

    def _render_traceback_(self) -> list[str]:
        """Let IPython show only the message, without a traceback."""
        return [f"InputError: {self}"]


def need(name: str, value: object, kind: Any) -> None:
    """Raise InputError unless an argument of a public function is of a kind: a type, or "A | B"."""
    if not isinstance(value, kind):
        raise InputError(
            f"{name}: must be {getattr(kind, '__name__', kind)}, not {type(value).__name__}"
        )


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]
