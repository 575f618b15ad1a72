"""The page with all tables and figures of a run: index.html beside them.

It needs no network or server. README.md beside it is a gallery of the same, for reading in a
repository.

`update` copies the figures and tables of a run to the folder in which they are read, writes page
and gallery there, and converts executed notebooks to HTML. `make page` only writes page and
gallery.
"""

import itertools
import os
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from markupsafe import Markup

from keypoint_study.report import html, texts
from thesis import captions, timing
from thesis.settings import ROOT, Settings, read_settings
from thesis_repro.running import program, provenance
from thesis_repro.running.files import atomic, listed, write_text

GALLERY = "README.md"
REAL = "kitti_excerpts"  # folder of the evidence on real frames (tools/evidence.py)
REAL_CHAPTER = "Chapter 4 on real frames"
# ids of the artefacts at the top of the page
OPENING = ("findings", "figure_4_05", "figure-comparison")


def update(settings: Settings, folder: Path) -> None:
    """Write the page of a run into a folder, with its figures and tables.

    Converts each executed notebook that is newer than its HTML. Deletes temporary files of killed
    runs. Raises InputError if another run uses the folder.
    """
    with provenance.claimed(settings.build / "notebooks"):
        provenance.sweep(settings.build)
        if folder.is_dir():
            provenance.sweep(folder)
        _copy(settings, folder)
        settings = replace(settings, figures=folder)
        for path in _executed(settings):
            converted = path.with_suffix(".html")
            if not converted.is_file() or converted.stat().st_mtime < path.stat().st_mtime:
                write_text(converted, notebook_html(path, folder / html.PAGE))
        write_text(folder / html.PAGE, build(settings))
        write_text(folder / GALLERY, gallery(settings))


def _copy(settings: Settings, folder: Path) -> None:
    """Copy what a run has drawn, and from the figures in git those that show no data."""
    files = {path.relative_to(settings.figures): path for path in settings.figures.rglob("*.*")}
    for name in captions.CONSTANT:
        for path in (ROOT / "figures").glob(f"{name}.*"):
            files.setdefault(Path(path.name), path)
    for name, path in files.items():
        with atomic(folder / name) as temporary:
            shutil.copyfile(path, temporary)


def _executed(settings: Settings) -> list[Path]:
    return listed(settings.build / "notebooks", "*.ipynb")


def notebook_html(path: Path, page_path: Path) -> str:
    """Convert an executed notebook to HTML with a link to the page."""
    import nbformat  # these are slow to import, and seldom needed
    from latex2mathml.converter import convert
    from nbconvert import HTMLExporter

    def mathml(equation: re.Match) -> str:
        return convert(equation[1], display="block")

    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":  # browsers show MathML without scripts
            cell.source = re.sub(r"\$\$(.+?)\$\$", mathml, cell.source, flags=re.DOTALL)
    # nbconvert's complete pages load scripts from the network, but the basic template does not;
    # without embed_images, which would take MathML apart; pictures of outputs are embedded anyway
    exporter = HTMLExporter(
        template_name="basic",
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        exclude_anchor_links=True,
    )
    content, resources = exporter.from_notebook_node(notebook)
    return texts.render(
        "notebook.html.j2",
        title=path.stem,
        content=Markup(content),
        style=Markup("\n".join(resources["inlining"]["css"])),
        page=os.path.relpath(page_path, path.parent),
    )


def _chapters(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Return the described artefacts of each chapter, {title: artefacts}.

    The figures in git begin with chapter 4 on real frames.
    """
    chapters = {}
    if settings.figures_in_git:
        chapters[REAL_CHAPTER] = _of_real_frames(settings)
    numbers = beside_the_thesis(settings)
    for title, artefacts in (captions.CHAPTERS | {"Beyond the thesis": captions.ADDED}).items():
        chapters[title] = [_describe(artefact, settings, numbers) for artefact in artefacts]
    return chapters


def _of_real_frames(settings: Settings) -> list[dict[str, Any]]:
    """Return the described artefacts of the evidence on real frames that is in git."""
    real = replace(settings, figures=settings.figures / REAL, kitti_is_embedded=False)
    numbers = beside_the_thesis(real)
    few, others = (
        [artefact for artefact in captions.ADDED if artefact["name"] in names]
        for names in (["few_keypoints"], ["comparison", "widths"])
    )
    chapter = [*few, *captions.CHAPTERS["Chapter 4: results"], *others]
    described = [_describe(artefact, real, numbers) for artefact in chapter]
    for artefact in described:
        artefact["id"] = f"real-{artefact['id']}"
        artefact["files"] = [f"{REAL}/{name}" for name in artefact["files"]]
        artefact["opens"] = False
    return [artefact for artefact in described if artefact["there"]]


def build(settings: Settings) -> str:
    """Return the page of a run as HTML, made from the files in its folders."""
    chapters = _chapters(settings)
    of_run = [artefacts for title, artefacts in chapters.items() if title != REAL_CHAPTER]
    artefacts = list(itertools.chain(*of_run))
    of_thesis = [artefact for artefact in artefacts if artefact["number"] is not None]
    docs = _links_to_documents(settings)
    answer = _answer(docs) if docs and settings.figures_in_git else None
    executed, made = [], html.versions()
    if not settings.figures_in_git:  # a clone has no executed notebooks
        executed, made = _executed(settings), made | html.machine()
    if executed:
        latest = max(path.stat().st_mtime for path in executed)
        made["day"] = f"{datetime.fromtimestamp(latest, UTC):%d %B %Y}"
    links = [os.path.relpath(path.with_suffix(".html"), settings.figures) for path in executed]
    return texts.render(
        "page.html.j2",
        title=f"Keypoint masks, {settings.run}",
        settings=settings,
        chapters=chapters,
        shown=sum(artefact["there"] for artefact in of_thesis),
        of=len(captions.THESIS),
        card=captions.CARD,
        missing=[each for each in artefacts if not (each["there"] or each["left_out"])],
        docs=docs,
        lead=answer,
        notebooks={path.stem: link for path, link in zip(executed, links)},
        folder=os.path.relpath(settings.build / "notebooks", settings.figures),
        made=made,
    )


def gallery(settings: Settings) -> str:
    """Return the gallery of a run as Markdown, made from the files in its folders."""
    chapters = _chapters(settings)
    return texts.render("gallery.md.j2", settings=settings, chapters=chapters, page=html.PAGE)


def _links_to_documents(settings: Settings) -> str | None:
    """Return the way from the page to the folder docs; None if the page may move without it."""
    if not settings.figures.is_relative_to(ROOT):
        return None
    return quote(os.path.relpath(ROOT / "docs", settings.figures))


def _answer(docs: str) -> Markup:
    """Return the answer and what to do of docs/answer.md. docs: the way to that folder."""
    text = (ROOT / "docs" / "answer.md").read_text(encoding="utf-8")
    answer, to_do = (part.partition("\n\n")[2] for part in text.split("\n\n## ")[:2])
    return html.from_markdown(re.sub(r"\]\((?!\w+:|#)", f"]({docs}/", f"{answer}\n\n{to_do}"))


def _describe(
    artefact: dict[str, Any], settings: Settings, numbers: dict[str, Any]
) -> dict[str, Any]:
    """Return the values that a template needs to show an artefact of a run.

    numbers: of the run, from `beside_the_thesis`.
    """
    name, needs = artefact["name"], artefact.get("needs")
    described = html.describe(settings.figures, artefact)
    if name in captions.THESIS:
        # figure_4_07 is Figure 4.7, figure_a_01 is Figure A.1
        _, chapter, count = name.split("_")
        described["number"] = f"{artefact['kind'].capitalize()} {chapter.upper()}.{int(count)}"
        described["id"] = name
    described["opens"] = described["there"] and described["id"] in OPENING
    described["makers"] = [
        notebook for notebook, names in captions.MADE_BY.items() if name in names
    ]
    if thesis := described["thesis"]:
        described["thesis"] = thesis | _beside(thesis, settings, numbers.get(name))
    # a run on real frames does not make what needs a variable that is not set
    is_given = needs == "KITTI_SEMANTIC" and settings.kitti_semantic
    if needs and settings.uses_shipped_model and not (described["there"] or is_given):
        described["left_out"] = needs
    return described


def _beside(
    thesis: dict[str, Any], settings: Settings, numbers: dict[str, Any] | None
) -> dict[str, Any]:
    """Return what the thesis reports beside an artefact and what this run gives, as texts.

    thesis: the templates, see `captions`. numbers: of this run, or None if it has none.
    """
    fill = texts.TEMPLATES.from_string
    embedded = {"runs": settings.kitti_is_embedded, "training": settings.cityscapes_is_embedded}
    return {
        "text": fill(thesis["text"]).render(captions.REPORTED),
        "here": numbers is not None and fill(thesis["here"]).render(numbers),
        "embedded": embedded.get(thesis["data"], False),
    }


def beside_the_thesis(settings: Settings) -> dict[str, Any]:
    """Return this run's numbers for artefacts whose numbers the thesis reports in its text.

    Their form is {name of the artefact: numbers}. A name is missing if its file was not written.
    """
    numbers: dict[str, Any] = {}
    history = _table(settings.figures / "figure_4_01.csv")
    if len(history):
        best, last = history.loc[history["val_loss"].idxmin()], history.iloc[-1]
        numbers["figure_4_01"] = {"epochs": len(history), "best": dict(best), "last": dict(last)}
    chosen = _table(settings.figures / "table_4_1.csv")
    if "mean keypoints" in chosen:
        numbers["figure_4_07"] = {"keypoints": chosen["mean keypoints"].clip(lower=1)}
    seconds = _table(settings.figures / "timings" / "seconds.csv")
    if len(seconds):
        numbers["figure_4_17"] = {"saved": 0 - timing.time_savings(seconds)}
    return numbers


def _table(path: Path) -> pd.DataFrame:
    """Return a CSV file as a table; an empty one if there is no such file."""
    return pd.read_csv(path).convert_dtypes() if path.is_file() else pd.DataFrame()


def main() -> None:
    """Write the page and the gallery anew from the figures in git."""
    settings = read_settings()
    settings = replace(settings, figures=settings.published)
    write_text(settings.figures / html.PAGE, build(settings))
    write_text(settings.figures / GALLERY, gallery(settings))


if __name__ == "__main__":
    program.run_main(main)
