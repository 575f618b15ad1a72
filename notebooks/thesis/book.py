"""The book: executed notebooks, gallery and documents as pages to read in a browser."""

import shutil
import subprocess
import sys
from pathlib import Path

from thesis import gallery
from thesis.run_settings import ROOT, Settings, read_settings
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import listed

# what the pages are made of, and the files that they link
PARTS = (
    "*.md",
    "LICENSE",
    "CITATION.cff",
    "Dockerfile",
    "environment*.txt",
    "docs/*",
    "figures/*.*",
    f"figures/{gallery.REAL}/**/*",
    "figures/camvid/*",
    "tools/*.py",
    "tests/reference/*.md",
    "opencv_exact/*.md",
    "thesis_repro/**/*.md",
    "thesis_repro/**/*.py",
    "keypoint_study/**/*.py",
)


def build(settings: Settings) -> int:
    """Write the book of a run, and return Sphinx's status. A warning is an error."""
    folder = settings.build / "book"
    shutil.rmtree(folder, ignore_errors=True)
    for place, path in _parts(settings).items():
        copy = folder / "source" / place
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    places = ["-c", ROOT / "docs", "-d", folder / "read", folder / "source", folder / "html"]
    command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going"]
    status = subprocess.run([*command, *map(str, places)]).returncode
    print(f"to read: {folder / 'html' / 'index.html'}")
    return status


def _parts(settings: Settings) -> dict[Path, Path]:
    """Return the files of the book, {place in the book: file}."""
    paths = (path for pattern in PARTS for path in ROOT.glob(pattern) if path.is_file())
    parts = {path.relative_to(ROOT): path for path in paths}
    parts[Path("index.md")] = ROOT / "docs" / "index.md"
    executed = listed(settings.build / "notebooks", "*.ipynb")  # without Cityscapes, not all
    for path in [*ROOT.glob("notebooks/*.ipynb"), *executed]:
        parts[Path("notebooks", path.name)] = path
    if not settings.figures_in_git:
        for path in listed(settings.published, "*.*"):
            parts[Path("results", path.name)] = path
    return parts


def main() -> int:
    """Write the book. Raises InputError if no notebook has been executed."""
    settings = read_settings()
    if not listed(settings.build / "notebooks", "*.ipynb"):
        raise InputError(f"{settings.build}: has no executed notebook; run make figures first")
    return build(settings)


if __name__ == "__main__":
    program.run_main(main)
