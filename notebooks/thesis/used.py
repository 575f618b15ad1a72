"""Which code each notebook uses: its contents, not its times, decide what is executed again."""

import json
import re
from contextlib import suppress
from modulefinder import ModuleFinder
from pathlib import Path

from thesis.settings import ROOT
from thesis_repro.running.files import write_text
from thesis_repro.running.provenance import digest_of_file

LEARNING = "thesis_repro/data", "thesis_repro/segmentation", "street_world"
PATHS = *LEARNING, "thesis_repro/masks", "thesis_repro/odometry", "opencv_exact"
DRAWING = *PATHS, "keypoint_study", "notebooks/thesis"
# the code that the results of a notebook depend on, beside what it imports of `thesis`
ROOMS: dict[str, tuple[str, ...]] = {
    "01_load_images_and_labels": LEARNING,
    "02_augmentation": LEARNING,
    "03_unet": LEARNING,
    "04_training": LEARNING,
    "05_prediction": PATHS,
    "06_keypoint_masks": PATHS,
    "07_visual_odometry": PATHS,
    "08_results": DRAWING,
    "09_audit": DRAWING,
}


def reached(root: Path) -> list[Path]:
    """Return the modules of a checkout that any import reaches from the notebooks' cells.

    A new file that nothing imports is none of them. A module's data file has its name.
    """
    finder = ModuleFinder([str(root), str(root / "notebooks")])
    main = finder.add_module("__main__")
    for name in ROOMS:
        with suppress(SyntaxError, ValueError):  # are told when the notebook is executed
            notebook = json.loads((root / f"notebooks/{name}.ipynb").read_text(encoding="utf-8"))
            for cell in notebook["cells"]:
                code = re.sub("^[%!].*", "", "".join(cell["source"]), flags=re.MULTILINE)
                if cell["cell_type"] == "code":
                    finder.scan_code(compile(code, name, "exec"), main)
    modules = [Path(vars(module)["__file__"] or "") for module in finder.modules.values()]
    beside = [path.with_suffix(".json") for path in modules if path.suffix]
    return sorted(filter(Path.is_file, modules + beside))


def record(folder: Path, root: Path = ROOT) -> None:
    """Write for each notebook a file with the digests of what it uses, if they have changed.

    folder: of the run. The Makefile executes a notebook again if this file is new.
    """
    digests = {path: digest_of_file(path) for path in reached(root)}
    for name, rooms in ROOMS.items():
        notebook, path = root / f"notebooks/{name}.ipynb", folder / "code" / name
        imports = re.findall("from thesis import ([a-z0-9_, ]*)", notebook.read_text("utf-8"))
        named = re.findall(r"\w+", " ".join(imports))
        lines = [f"{digest_of_file(notebook)} {name}\n"]
        for file, digest in digests.items():
            place = file.relative_to(root)
            is_named = place.parent.name == "thesis" and place.stem in named
            if is_named or any(map(place.is_relative_to, rooms)):
                lines.append(f"{digest} {place}\n")
        if not path.is_file() or path.read_text(encoding="utf-8") != "".join(lines):
            write_text(path, "".join(lines))
