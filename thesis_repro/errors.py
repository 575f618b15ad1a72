"""Bad input: the exception that every command turns into one line, and how it is raised."""

from typing import Any

# modules that only some commands need, by the extra of this package that installs them
EXTRAS = {
    "segmentation": (
        "tensorflow",
        "keras",
        "h5py",
        "segmentation_models",
        "albumentations",
    ),
    "notebooks": ("IPython", "ipywidgets", "nbconvert", "nbformat", "latex2mathml", "livelossplot"),
    "cluster": ("dask", "distributed"),
}


def one_line(text: object) -> str:
    r"""Return a text as one printable line.

    Line breaks and control characters become escape sequences such as \n.
    """
    return "".join(
        letter
        if letter.isprintable()
        else letter.encode("unicode_escape", "surrogatepass").decode()
        for letter in str(text)
    )


class InputError(ValueError):
    """Bad input.

    The message is one line that names the file or setting, the problem, and what to do.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())  # file names may hold any character

    def _render_traceback_(self) -> list[str]:
        """Let IPython show only the message, without a traceback."""
        return [f"InputError: {self}"]


def cause(error: Exception) -> str:
    """Return why something failed as one line; of other errors than bad input with their name."""
    if isinstance(error, InputError):
        return str(error)
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def need(name: str, value: object, kind: Any) -> None:
    """Raise InputError unless an argument of a public function is of a kind: a type, or "A | B"."""
    if not isinstance(value, kind):
        raise InputError(
            f"{name}: must be {getattr(kind, '__name__', kind)}, not {type(value).__name__}"
        )


def missing_package(error: ImportError) -> InputError | None:
    """Return an InputError that says what to install, or None if another import failed.

    OpenCV is missing if none of its four distributions is installed, or if the system lacks a
    library that the installed one needs.
    """
    module = (error.name or "").partition(".")[0]
    if module == "cv2":
        return InputError(
            f"OpenCV: cannot be imported ({error}); run pip install opencv-python-headless, or "
            "another of its distributions"
        )
    for extra, modules in EXTRAS.items():
        if module in modules:
            return InputError(
                f'{module}: is not installed; run pip install "thesis-repro[{extra}]"'
            )
    return None
