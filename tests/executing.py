"""Execute every notebook once, on the smallest profile, as they are in git."""

import os
import subprocess
import sys

from cells import NOTEBOOKS

from thesis.run_settings import PREFIX, ROOT

# what a kernel sees of this process's variables: nothing that the Makefile sets
KEPT = ("PATH", "HOME", "LANG", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
# that cells show, and that are saved; large ones take a tenth of the time and prove no more
SMALL_PICTURES = """
get_config().InlineBackend.print_figure_kwargs = {"bbox_inches": None, "dpi": 40}
get_config().InteractiveShellApp.exec_lines = [
    "from keypoint_study.report.style import SETTINGS; SETTINGS['savefig.dpi'] = 40"
]
"""
NBCONVERT = [sys.executable, "-m", "nbconvert", "--to=notebook", "--execute"]
# as in the Makefile
NBCONVERT += [
    f"--ExecutePreprocessor.{option}"
    for option in ("kernel_name=python3", "timeout=-1", "shutdown_kernel=immediate")
]


def run_of(folder):
    """The settings of the run in a folder, as variables.

    Without worker processes, which would each load what is compiled.
    """
    folders = {f"{PREFIX}{name.upper()}": str(folder / name) for name in ("build", "figures")}
    return folders | {f"{PREFIX}PROFILE": "smoke", f"{PREFIX}JOBS": "1"}


def execute(folder, world):
    """Let nbconvert execute every notebook and write it with its outputs.

    One call for all spares its start, which takes seconds. world: a rendered one, which is not
    rendered again.
    """
    run = folder / "build/embedded-smoke"
    run.mkdir(parents=True)
    (run / "checked").touch()  # as if make had checked the data
    (folder / "build/world-smoke").symlink_to(world)
    profile = folder / "ipython/profile_default"
    profile.mkdir(parents=True)
    (profile / "ipython_kernel_config.py").write_text(SMALL_PICTURES)
    variables = {name: os.environ[name] for name in KEPT if name in os.environ}
    variables |= {"IPYTHONDIR": str(folder / "ipython"), "JUPYTER_NO_CONFIG": "1"}
    variables |= {"PYTHONPATH": str(ROOT)} | run_of(folder)
    notebooks = [ROOT / "notebooks" / name for name in NOTEBOOKS]
    command = [*NBCONVERT, f"--output-dir={run / 'notebooks'}", *notebooks]
    subprocess.run(command, env=variables, check=True)
    (run / "sequences").touch()  # as if make had rendered them
