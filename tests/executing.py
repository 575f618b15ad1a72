"""Execute every notebook once, on the smallest profile, as they are in git."""

import os

import nbformat
from cells import NOTEBOOKS
from nbclient import NotebookClient

from thesis.run_settings import PREFIX, ROOT

# what a kernel sees of this process's variables: nothing that the Makefile sets
KEPT = ("PATH", "HOME", "LANG", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
# that cells show; those that are saved are as usual
SMALL_PICTURES = """
get_config().InlineBackend.print_figure_kwargs = {"bbox_inches": None, "dpi": 40}
"""


def run_of(folder):
    """The settings of the run in a folder, as variables.

    Without worker processes, which would each load what is compiled.
    """
    folders = {f"{PREFIX}{name.upper()}": str(folder / name) for name in ("build", "figures")}
    return folders | {f"{PREFIX}PROFILE": "smoke", f"{PREFIX}JOBS": "1"}


def execute(folder, world):
    """Execute every notebook in its folder by what nbconvert uses, and write it with its outputs.

    This spares the start of nbconvert, three seconds each. world: a rendered one, which is not
    rendered again.
    """
    run = folder / "build/embedded-smoke"
    (run / "notebooks").mkdir(parents=True)
    (run / "checked").touch()  # as if make had checked the data
    (folder / "build/world-smoke").symlink_to(world)
    profile = folder / "ipython/profile_default"
    profile.mkdir(parents=True)
    (profile / "ipython_kernel_config.py").write_text(SMALL_PICTURES)
    variables = {name: os.environ[name] for name in KEPT if name in os.environ}
    variables |= {"IPYTHONDIR": str(folder / "ipython"), "PYTHONPATH": str(ROOT)} | run_of(folder)
    for name in NOTEBOOKS:
        notebook = nbformat.read(ROOT / "notebooks" / name, 4)
        place = {"metadata": {"path": str(ROOT / "notebooks")}}
        client = NotebookClient(
            notebook, kernel_name="python3", shutdown_kernel="immediate", resources=place
        )
        client.execute(env=variables)
        nbformat.write(notebook, run / "notebooks" / name)
        if name == NOTEBOOKS[0]:
            (run / "sequences").touch()  # as if make had rendered them
