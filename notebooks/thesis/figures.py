"""Execute the notebooks of a run, and write its gallery and book: what `make figures` does.

The Makefile knows which notebook needs what. This holds the lock of the run while make works.
"""

import os
import platform
import subprocess
import sys

from thesis import book, checked, gallery, timing, used
from thesis.settings import ROOT, Settings, read_settings
from thesis_repro.running import program, provenance
from thesis_repro.running.files import listed, write_text

RECORDED_NETWORK = "4ac3c7d86e69"  # digest of the one behind the figures in git


def main() -> int:
    """Execute what is not up to date, write gallery and book, and return make's status.

    A notebook that fails does not stop those that do not need it. Raises InputError if another run
    uses the folder.
    """
    settings = read_settings()
    if settings.figures_in_git and platform.machine() not in ("x86_64", "AMD64"):
        program.log.warning(
            f"figures: those in git are from an x86 processor; on {platform.machine()} some numbers "
            "will differ; FIGURES=/path keeps both"
        )
    with provenance.claimed(settings.build / "notebooks"):
        if not checked.check(settings):
            return 1
        used.record(settings.build)
        status = _execute(settings)
        gallery.update(settings)
        status = book.build(settings) or status
    if note := network_note(settings):
        print(note)
    return status


def network_note(settings: Settings) -> str:
    """Return one line that says whether a run's network is the recorded one, to the bit.

    It is empty for a run of other data or sizes. The digest of the network's weights is in the
    record of its label maps.
    """
    folders = listed(settings.build / "labels", "*")
    if not settings.figures_in_git or not folders:
        return ""
    network = provenance.record(folders[0])["model"]
    if network == RECORDED_NETWORK:
        return f"The network of this run is the recorded one, to the bit ({network})."
    return (
        f"The network of this run ({network}) is not the recorded one ({RECORDED_NETWORK}), so numbers differ. "
        "Causes: a notebook was edited; TensorFlow or Keras have another version; a GPU was used; the "
        "processor is not x86, or has no AVX2; TF_ENABLE_ONEDNN_OPTS, ONEDNN_MAX_CPU_ISA, XLA_FLAGS or "
        "TF_NUM_INTRAOP_THREADS were set."
    )


def shows_times_of_git(settings: Settings) -> bool:
    """Whether a run's figures show times in git. Of frames that were never timed there are none."""
    folder = timing.folder_in_git(settings)
    return folder is not None and folder.is_dir()


def _execute(settings: Settings) -> int:
    ipython = settings.build / "ipython"
    # what a kernel's compiled code says at its death goes to the log, not into the lost notebook
    config = "get_config().IPKernelApp.capture_fd_output = False\n"
    write_text(ipython / "profile_default/ipython_kernel_config.py", config)
    at_once = [] if settings.jobs == 1 else ["-j2"]
    folder = os.path.relpath(settings.build, ROOT)
    command = [os.environ.get("MAKE", "make"), "-k", *at_once, "notebooks", f"RUN={folder}"]
    if shows_times_of_git(settings):  # else 09 also reads those that 08 writes at its end
        command.append("LAST=shuffled_runs.csv")
    # bars inside notebooks go to the terminal; a kernel that crashes says how
    terminal = os.ttyname(2) if sys.stderr.isatty() else os.devnull
    variables = {"IPYTHONDIR": str(ipython.resolve()), "THESIS_REPRO_PROGRESS": terminal}
    variables["PYTHONFAULTHANDLER"] = "1"
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | variables)
    try:
        return process.wait()
    finally:  # after Ctrl-C, too
        process.terminate()
        process.wait()


if __name__ == "__main__":
    program.run_main(main)
