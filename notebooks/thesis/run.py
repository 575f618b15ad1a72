"""Execute the notebooks of a run, and write its gallery: what `make figures` does.

This deletes what was made from other contents, and holds the lock of the run while make executes
what is missing.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
from itertools import chain
from pathlib import Path

from thesis import gallery, real_frames
from thesis.run_settings import ROOT, Settings, read_settings
from thesis_repro.checks import report
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.running import program, provenance
from thesis_repro.running.files import listed, write_text

RECORDED_NETWORK = "4ac3c7d86e69"  # digest of the one behind the figures in git
# the sequences of the embedded world, which are rendered while notebook 04 trains, to save time
RENDERED = "sequences"
# what make makes, in order, and what each needs
NEEDS = {
    "01_load_images_and_labels": [],
    RENDERED: ["01_load_images_and_labels"],
    "02_augmentation": ["01_load_images_and_labels"],
    "03_unet": [],
    "04_training": ["02_augmentation", "03_unet"],
    "05_prediction": ["04_training", RENDERED],
    "06_keypoint_masks": ["05_prediction"],
    "07_visual_odometry": ["06_keypoint_masks"],
    "08_results": ["06_keypoint_masks"],
    "09_audit": ["08_results"],
}
OF_TRAINING = ("01_load_images_and_labels", "02_augmentation", "04_training")
PACKAGES = ("thesis_repro", "keypoint_study", "opencv_exact", "street_world", "notebooks/thesis")
TIMES = ("figures/timings/*.csv", "figures/kitti_excerpts/timings/*.csv")
# patterns of files of the project, beside code, that a notebook reads
DATA = {
    "04_training": ["figures/camvid/figure_4_01.csv"],
    "05_prediction": ["thesis_repro/segmentation/weights/*.keras"],
    "08_results": TIMES,
    "09_audit": [*TIMES, "notebooks/thesis/audit.json"],
}


def main() -> int:
    """Execute what is not up to date, write the gallery, and return make's status.

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
        if not check(settings):
            return 1
        names = wanted(settings)
        drop_old(settings, names)
        try:
            status = _execute(settings, names)
        finally:
            write_text(settings.build / "drawn", json.dumps(_drawn(settings)))
        gallery.update(settings)
    page = os.path.relpath(settings.published / "README.md")
    print(f"to read: {page}; `make book`, with the same settings, writes pages for a browser")
    if note := network_note(settings):
        print(note)
    return status


def check(settings: Settings) -> bool:
    """Check the data of a run, unless it was checked before, and return whether it is sound.

    The names, sizes and times of the files are written beside the results, and again if they have
    changed: then the notebooks are executed again. Raises InputError if a file is missing.
    """
    for name, first, last in settings.ranges:
        real_frames.cut(Sequence(settings.whole, name), first, last, settings.kitti, name)
    path = settings.build / "checked"
    kitti_root = None if settings.kitti_is_embedded else settings.kitti
    cityscapes_root = None if settings.cityscapes_is_embedded else settings.cityscapes
    used: list[Path] = []
    for name in kitti.sequences(kitti_root) if kitti_root else ():
        used += Sequence(kitti_root, name).subset(settings.sizes.frames).files
    splits = (
        (cityscapes_root, "train"),
        (cityscapes_root, "val"),
        (settings.kitti_semantic, "train"),
    )
    for root, split in splits:
        used += chain(*[pair[1:] for pair in cityscapes.pairs(root, split)]) if root else ()
    lines = [f"{file} {file.stat().st_size} {file.stat().st_mtime_ns}\n" for file in used]
    checked = ascii("".join(lines))  # names may hold any bytes
    if path.is_file() and path.read_text(encoding="utf-8") == checked:
        return True
    sound = report(kitti_root, cityscapes_root, settings.kitti_semantic)
    if sound:
        write_text(path, checked)
    return sound


def wanted(settings: Settings) -> list[str]:
    """Return what a run makes: with real frames, no rendering; with them alone, no training."""
    names = [name for name in NEEDS if settings.kitti_is_embedded or name != RENDERED]
    if settings.uses_shipped_model:
        names = [name for name in names if name not in OF_TRAINING]
    return names


def drop_old(settings: Settings, names: list[str]) -> None:
    """Delete what was made from other contents, and what needs that; make then makes it again.

    Contents decide, not dates: a clock may have been wrong. A file for each notebook in `code` has
    a digest of its code, the packages, and the data. It is written after the notebook is deleted,
    so nothing old can pass for new. An edited sentence is put into what a notebook made.
    A lesson that was edited and run by hand has drawn into the same folder: what draws this is
    executed again, too.
    """
    checked = provenance.digest_of_file(settings.build / "checked")
    changed = _changed(settings)
    dropped: set[str] = set()
    for name in names:
        notebook, product = ROOT / f"notebooks/{name}.ipynb", _product(settings.build, name)
        code = [] if name == RENDERED else _code(notebook)
        digest = f"{_digest(name, code)} {checked}"
        record = settings.build / "code" / name
        is_same = record.is_file() and record.read_text(encoding="utf-8") == digest
        edited = [each for each in changed if f'"{Path(each).stem}' in "".join(code)]
        if edited:
            program.log.info(f"{name}: executed again, because {edited[0]} was changed by hand")
        if edited or not is_same or not product.is_file() or dropped & {*NEEDS[name]}:
            dropped.add(name)
            product.unlink(missing_ok=True)
            write_text(record, digest)
        elif name != RENDERED:
            _put_sentences(notebook, product)


def _drawn(settings: Settings) -> dict[str, str]:
    """Return digests of the figures and tables of a run, {name of the file: digest}."""
    paths = filter(Path.is_file, settings.figures.rglob("*.*"))
    return {path.name: provenance.digest_of_file(path) for path in paths}


def _changed(settings: Settings) -> list[str]:
    """Return names of the figures and tables that are not as `main` has left them."""
    record = settings.build / "drawn"
    left = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else {}
    now = _drawn(settings)
    return [name for name in left if now.get(name) != left[name]]


def _product(build: Path, name: str) -> Path:
    """Return the file that tells make that something is made."""
    return build / name if name == RENDERED else build / f"notebooks/{name}.ipynb"


def _digest(name: str, code: list[str] | str) -> str:
    """Return a digest of a notebook's code, of the packages, and of the project's data for it."""
    read = chain(*(sorted(ROOT.glob(pattern)) for pattern in DATA.get(name, ())))
    packages = provenance.digest_of_code(*PACKAGES)
    contents = json.dumps([code, packages, provenance.digest_of_files(read)])
    return hashlib.sha256(contents.encode()).hexdigest()


def _code(notebook: Path) -> list[str] | str:
    """Return the code cells of a notebook; all its text if it is damaged, which nbconvert tells."""
    text = notebook.read_text(encoding="utf-8", errors="replace")
    try:
        cells = json.loads(text)["cells"]
        return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    except (ValueError, KeyError, TypeError):
        return text


def _put_sentences(notebook: Path, executed: Path) -> None:
    """Give an executed notebook the sentences that its notebook has now, around the same code."""
    made = json.loads(executed.read_text(encoding="utf-8"))
    code = (cell for cell in made["cells"] if cell["cell_type"] == "code")
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    cells = [next(code) if cell["cell_type"] == "code" else cell for cell in cells]
    if cells != made["cells"]:
        text = json.dumps(made | {"cells": cells}, indent=1, ensure_ascii=False)
        write_text(executed, text + "\n")


def rules(names: list[str]) -> str:
    """Return which of these need which, as rules of make. Dates do not count (`|`)."""
    places = {name: _product(Path("$(RUN)"), name) for name in names}
    lines = [f"notebooks: {' '.join(map(str, places.values()))}"]
    for name in names:
        needed = [str(places[other]) for other in NEEDS[name] if other in places]
        lines.append(f"{places[name]}: | {' '.join(needed)}")
    return "\n".join(lines) + "\n"


def _execute(settings: Settings, names: list[str]) -> int:
    """Let make execute what is missing, and return its status."""
    write_text(settings.build / "needs.mk", rules(names))
    ipython = settings.build / "ipython"
    # what a kernel's compiled code says at its death goes to the log, not into the lost notebook
    config = "get_config().IPKernelApp.capture_fd_output = False\n"
    write_text(ipython / "profile_default/ipython_kernel_config.py", config)
    at_once = [] if settings.jobs == 1 else ["-j2"]
    folder = os.path.relpath(settings.build, ROOT)
    command = [os.environ.get("MAKE", "make"), "-k", *at_once, "notebooks", f"RUN={folder}"]
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


if __name__ == "__main__":
    program.run_main(main)
