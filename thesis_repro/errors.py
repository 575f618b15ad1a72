"""Bad input: the exception that every command turns into one line, and how it is raised."""

from importlib.util import find_spec
from traceback import walk_tb

# compiled packages that every command needs, and what installs them; any OpenCV will do
COMPILED = {"cv2": "opencv-python-headless", "numpy": "numpy"}
# modules that only some commands need, by what installs them
OPTIONAL = {
    "thesis-repro": ("keypoint_study", "street_world"),
    "thesis-repro[segmentation]": (
        "tensorflow",
        "keras",
        "h5py",
        "segmentation_models",
        "albumentations",
    ),
    "thesis-repro[notebooks]": (
        "IPython",
        "ipywidgets",
        "nbconvert",
        "nbformat",
        "latex2mathml",
        "livelossplot",
    ),
    "thesis-repro[cluster]": ("dask", "distributed"),
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


def need(name: str, value: object, kind: type) -> None:
    """Raise InputError unless an argument of a public function is of a type."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: must be {kind.__name__}, not {type(value).__name__}")


def missing_package(error: ImportError | AttributeError) -> InputError | None:
    """Return an InputError that says what to install, or None if another import failed.

    OpenCV and NumPy also fail if the system lacks a library that they need, if some of their files
    were removed, or if PYTHONPATH names those of another Python.
    """
    names = [frame.f_globals.get("__name__", "") for frame, _ in walk_tb(error.__traceback__)]
    names.append(error.name or "")
    if isinstance(error, AttributeError):  # a folder without files is imported as an empty module
        names = [getattr(error.obj, "__name__", "")]
        if getattr(error.obj, "__file__", None):
            return None
    if "failed to map segment" in str(error):  # the loader's words
        return InputError(f"memory ran out, or the disk forbids programs: {error}")
    modules = [name.partition(".")[0] for name in names]
    for module in [module for module in reversed(modules) if module in COMPILED]:
        spec = find_spec(module)
        place = "not installed"
        if spec:
            place = spec.origin or str(spec.submodule_search_locations)
        return InputError(
            f"{module}: cannot be imported ({place}: {' '.join(str(error).split())[:200]}); run pip "
            f"install --force-reinstall {COMPILED[module]}, and unset PYTHONPATH if it is set"
        )
    for requirement, needed in OPTIONAL.items():
        if modules[-1] in needed:
            return InputError(f'{modules[-1]}: is not installed; run pip install "{requirement}"')
    return None
