"""The book: executed notebooks, gallery and documents as pages to read in a browser."""

import filecmp
import shutil
import subprocess
import sys
from pathlib import Path

from thesis import gallery
from thesis.settings import ROOT, Settings, read_settings
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


def build(settings: Settings, *options: str) -> int:
    """Write the book of a run, and return Sphinx's status. Only pages that changed are read again.

    options: for Sphinx.
    """
    folder = settings.build / "book"
    _arrange(_parts(settings), folder)
    pages = folder / "html"
    places = ["-c", ROOT / "docs", "-d", folder / "read", folder / "source", pages]
    command = [sys.executable, "-m", "sphinx", "--quiet", *options, *map(str, places)]
    status = subprocess.run(command).returncode
    print(f"to read: {pages / 'index.html'}")
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


def _arrange(parts: dict[Path, Path], folder: Path) -> None:
    """Make a book's source hold copies of these files and no others. What is equal stays.

    Every page lists all, so a book of other files, such as an earlier version's, is written anew.
    """
    source = folder / "source"
    there = {path.relative_to(source) for path in source.rglob("*") if path.is_file()}
    if there != set(parts):
        shutil.rmtree(folder, ignore_errors=True)
    for place, path in parts.items():
        copy = source / place
        if not (copy.is_file() and filecmp.cmp(path, copy, shallow=False)):
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)


def main() -> int:
    """Write the whole book, with the reference. A warning is an error.

    Raises InputError if no notebook has been executed.
    """
    settings = read_settings()
    if not listed(settings.build / "notebooks", "*.ipynb"):
        raise InputError(f"{settings.build}: has no executed notebook; run make figures first")
    return build(settings, "--tag", "reference", "--fail-on-warning", "--keep-going")


if __name__ == "__main__":
    program.run_main(main)
