"""The gallery: all figures and tables of a run on one page of Markdown, README.md beside them.

captions.json has what stands there. An artefact is a dict with kind ("figure", "table",
"text"), name (of its files), title and caption; those that a study has, too, have the study's.
Optional keys: constant: true if it shows no data. needs: the variable that a run on real frames
must set to make it. thesis: what the thesis reports, a dict of data and two Jinja templates, text
and here (for this run's numbers).
"""

import json
import shutil
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import pandas as pd

from keypoint_study.report import texts
from keypoint_study.report.comparison import CAPTIONS as OF_STUDIES
from thesis import REPORTED, audit, timing
from thesis.run_settings import ROOT, Settings, read_settings
from thesis_repro.running import program, provenance
from thesis_repro.running.files import atomic, write_text

_CAPTIONS = json.loads((Path(__file__).parent / "captions.json").read_text(encoding="utf-8"))
# the 36 figures and 5 tables of the thesis in its order, {chapter: artefacts}
CHAPTERS = _CAPTIONS["chapters"]
_OF_STUDIES = {
    ("figure", "comparison"): OF_STUDIES["ratios_drawn"],
    ("table", "comparison"): OF_STUDIES["ratios"],
    ("table", "widths"): OF_STUDIES["widths"],
    ("text", "findings"): ("What the runs show", ""),
}


def _added() -> list[dict[str, Any]]:
    """Return the artefacts that are not in the thesis. Those of studies have the study's words."""
    added = []
    for artefact in _CAPTIONS["added"]:
        words = _OF_STUDIES.get((artefact["kind"], artefact["name"]))
        if words:
            artefact = {"title": words[0], "caption": words[1]} | artefact
        added.append(artefact)
    return added


ADDED = _added()
OF_EVIDENCE = _CAPTIONS["evidence"]  # on real frames alone
# what is to be seen, {name of a figure, or id of a notebook's cell: alternative text}
SEEN = _CAPTIONS["seen"]
OF_THESIS = [*chain(*CHAPTERS.values())]
THESIS = [artefact["name"] for artefact in OF_THESIS]
CONSTANT = [artefact["name"] for artefact in OF_THESIS if artefact.get("constant")]
REAL = "kitti_excerpts"  # folder of the evidence on real frames (tools/evidence.py)
REAL_CHAPTER = "Chapter 4 on real frames"
ENDINGS = {"figure": (".svg", ".webp"), "table": (".md",), "text": (".md",)}
DEFAULTS = {"thesis": None, "needs": None, "rows": 0}  # what only some artefacts have


def update(settings: Settings) -> None:
    """Copy the figures and tables of a run to where they are read, with their gallery.

    Deletes temporary files of killed runs. Raises InputError if another run uses the folder.
    """
    folder = settings.published
    with provenance.claimed(settings.build / "notebooks"):
        provenance.sweep(settings.build)
        if folder.is_dir():
            provenance.sweep(folder)
        for name, path in _drawn(settings).items():
            with atomic(folder / name) as temporary:
                shutil.copyfile(path, temporary)
        write(settings)


def _drawn(settings: Settings) -> dict[Path, Path]:
    """Return the files that a run has drawn by name, and those in git that show no data."""
    files = {path.relative_to(settings.figures): path for path in settings.figures.rglob("*.*")}
    for name in CONSTANT:
        for path in (ROOT / "figures").glob(f"{name}.*"):
            files.setdefault(Path(path.name), path)
    return files


def write(settings: Settings) -> None:
    """Write the gallery beside the published figures of a run.

    In git, the audit's page has the numbers of real frames, too.
    """
    audits = [settings.published / place / "audit.csv" for place in (".", REAL)]
    if settings.figures_in_git and all(path.is_file() for path in audits):
        write_text(settings.published / "audit.md", page_of_audit(settings))
    write_text(settings.published / "README.md", text(settings))


def page_of_audit(settings: Settings) -> str:
    """Return the audit's page in git, made from the published tables."""
    folder = settings.published
    return audit.page(folder, folder / REAL, settings.data_note)


def text(settings: Settings) -> str:
    """Return the gallery, made from the published files of a run.

    That of the figures in git begins with chapter 4 on real frames.
    """
    chapters = {}
    if settings.figures_in_git:
        chapters[REAL_CHAPTER] = _of_real_frames(settings)
    for title, artefacts in (CHAPTERS | {"Beyond the thesis": ADDED}).items():
        chapters[title] = _described(artefacts, settings, settings.published)
    return texts.render("gallery.md.j2", settings=settings, chapters=chapters, real=REAL_CHAPTER)


def _of_real_frames(settings: Settings) -> list[dict[str, Any]]:
    """Return the described artefacts of the evidence on real frames that is in git."""
    chapter = [*CHAPTERS["Chapter 4: results"]]
    chapter += OF_EVIDENCE
    for names in (["few_keypoints"], ["comparison", "widths"]):
        chapter += [artefact for artefact in ADDED if artefact["name"] in names]
    real = replace(settings, kitti_is_embedded=False)
    described = _described(chapter, real, settings.published / REAL)
    for artefact in described:
        artefact["files"] = [f"{REAL}/{name}" for name in artefact["files"]]
    return [artefact for artefact in described if artefact["files"]]


def _described(
    artefacts: list[dict[str, Any]], settings: Settings, folder: Path
) -> list[dict[str, Any]]:
    """Return artefacts with the values that the template needs.

    These are the names of their files (none if they were not made), a number of the thesis, a table
    in Markdown with its number of rows, an alternative text, and what the thesis reports.
    """
    numbers = beside_the_thesis(folder)
    described = []
    for artefact in artefacts:
        name, kind = artefact["name"], artefact["kind"]
        paths = [path for end in ENDINGS[kind] if (path := folder / f"{name}{end}").is_file()]
        values: dict[str, Any] = {
            "files": [path.name for path in paths],
            "number": number(artefact),
            "seen": SEEN.get(name),
        }
        if paths and kind == "table":
            values["table"] = paths[0].read_text(encoding="utf-8")
            values["rows"] = sum(line.startswith("|") for line in values["table"].split("\n")) - 2
        if thesis := artefact.get("thesis"):
            values["thesis"] = _beside(thesis, settings, numbers.get(name))
        described.append(DEFAULTS | artefact | values)
    return described


def _beside(
    thesis: dict[str, Any], settings: Settings, numbers: dict[str, Any] | None
) -> dict[str, Any]:
    """Return what the thesis reports beside an artefact and what this run gives, as texts.

    thesis: the templates, see above. numbers: of this run, or None if it has none.
    """
    fill = texts.TEMPLATES.from_string
    embedded = {"runs": settings.kitti_is_embedded, "training": settings.cityscapes_is_embedded}
    return {
        "text": fill(thesis["text"]).render(REPORTED),
        "here": numbers is not None and fill(thesis["here"]).render(numbers),
        "embedded": embedded.get(thesis["data"], False),
    }


def beside_the_thesis(folder: Path) -> dict[str, Any]:
    """Return a run's numbers for artefacts whose numbers the thesis reports in its text.

    folder: of its figures. Their form is {name of the artefact: numbers}. A name is missing if its
    file was not written.
    """
    numbers: dict[str, Any] = {}
    history = _table(folder / "figure_4_01.csv")
    if len(history):
        best, last = history.loc[history["val_loss"].idxmin()], history.iloc[-1]
        numbers["figure_4_01"] = {"epochs": len(history), "best": dict(best), "last": dict(last)}
    chosen = _table(folder / "table_4_1.csv")
    if "mean keypoints" in chosen:
        numbers["figure_4_07"] = {"keypoints": chosen["mean keypoints"].clip(lower=1)}
    seconds = _table(folder / "timings" / "seconds.csv")
    if len(seconds):
        numbers["figure_4_17"] = {"saved": 0 - timing.time_savings(seconds)["1 thread"]}
    return numbers


def _table(path: Path) -> pd.DataFrame:
    """Return a CSV file as a table; an empty one if there is no such file."""
    return pd.read_csv(path).convert_dtypes() if path.is_file() else pd.DataFrame()


def main() -> None:
    """Write the gallery anew from published files, by default those in git."""
    write(read_settings())


if __name__ == "__main__":
    program.run_main(main)


def number(artefact: dict[str, Any]) -> str | None:
    """Return the number of a figure or table in the thesis: "Figure 4.7" for figure_4_07."""
    if artefact["name"] not in THESIS:
        return None
    kind, chapter, count = artefact["name"].split("_")
    return f"{kind.capitalize()} {chapter.upper()}.{int(count)}"
