"""The page with all tables and figures of a run or a study: index.html beside them.

It needs no network or server. README.md beside it is a gallery of the same, for reading in a
repository.

`python -m thesis_repro.report.page` writes the page, and converts executed notebooks to HTML.
"""

import importlib.metadata
import itertools
import os
import platform
import re
import subprocess
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from markupsafe import Markup

from thesis_repro.report import captions, tables, texts, trainings
from thesis_repro.running import messages, results
from thesis_repro.running.files import listed, write_text
from thesis_repro.running.settings import ROOT, Settings, read_settings

PAGE, GALLERY = "index.html", "README.md"
ENDINGS = {"figure": (".svg", ".webp", ".pdf"), "table": (".csv", ".md", ".tex"), "text": (".md",)}
REAL = "kitti_excerpts"  # folder of the evidence on real frames (tools/evidence.py)
REAL_CHAPTER = "Chapter 4 on real frames"
ROWS_SHOWN = 36  # the gallery only links to longer tables
# ids of the artefacts at the top of a page
OPENING = ("findings", "figure_4_05", "figure-comparison", "table-summary")
# packages that affect the numbers most
PACKAGES = ("tensorflow", "keras", *results.OPENCV, "numpy")


def update(settings: Settings) -> None:
    """Write the page of a run, and the HTML of each executed notebook that is newer than its HTML.

    Deletes temporary files of killed runs. Raises InputError if another run uses the folder.
    """
    with results.claimed(settings.build / "notebooks"):
        results.sweep(settings.build)
        _copy_constant(settings)
        if settings.figures.is_dir():
            results.sweep(settings.figures)
        page = settings.figures / PAGE
        for path in _executed(settings):
            html = path.with_suffix(".html")
            if not html.is_file() or html.stat().st_mtime < path.stat().st_mtime:
                write_text(html, notebook_html(path, page))
        write_text(page, build(settings))
        gallery = texts.render(
            "gallery.md.j2", settings=settings, chapters=_chapters(settings), page=PAGE
        )
        write_text(settings.figures / GALLERY, gallery)


def _copy_constant(settings: Settings) -> None:
    """Copy the figures that show no data from the default run if a run has not made them."""
    for name in captions.CONSTANT:
        for path in (ROOT / "figures").glob(f"{name}.*"):
            copy = settings.figures / path.name
            if not copy.exists():
                write_text(copy, path.read_text(encoding="utf-8"))


def _executed(settings: Settings) -> list[Path]:
    return listed(settings.build / "notebooks", "*.ipynb")


def notebook_html(path: Path, page: Path) -> str:
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
        page=os.path.relpath(page, path.parent),
    )


def _chapters(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Return the described artefacts of each chapter, {title: artefacts}.

    The figures in git begin with chapter 4 on real frames.
    """
    numbers = tables.beside_the_thesis(settings)
    chapters = {}
    if settings.figures_in_git:
        chapters[REAL_CHAPTER] = _of_real_frames(settings)
    for title, artefacts in (captions.CHAPTERS | {"Beyond the thesis": captions.ADDED}).items():
        chapters[title] = [
            _describe(settings.figures, artefact, settings, numbers) for artefact in artefacts
        ]
    return chapters


def _of_real_frames(settings: Settings) -> list[dict[str, Any]]:
    """Return the described artefacts of the evidence on real frames that is in git."""
    folder = settings.figures / REAL
    real = replace(settings, figures=folder, kitti_is_embedded=False)
    numbers = tables.beside_the_thesis(real)
    chapter = [
        *captions.CHAPTERS["Chapter 4: results"],
        *(artefact for artefact in captions.ADDED if artefact["name"] in ("comparison", "widths")),
    ]
    described = [_describe(folder, artefact, real, numbers) for artefact in chapter]
    for artefact in described:
        artefact["id"] = f"real-{artefact['id']}"
        artefact["files"] = [f"{REAL}/{name}" for name in artefact["files"]]
        artefact["opens"] = False
    return [artefact for artefact in described if artefact["there"]]


def build(settings: Settings) -> str:
    """Return the page of a run as HTML, made from the files in its folders."""
    chapters = _chapters(settings)
    of_run = [described for title, described in chapters.items() if title != REAL_CHAPTER]
    artefacts = list(itertools.chain(*of_run))
    of_thesis = [artefact for artefact in artefacts if artefact["number"] is not None]
    shown = sum(artefact["there"] for artefact in of_thesis)
    missing = [
        artefact for artefact in artefacts if not (artefact["there"] or artefact["left_out"])
    ]
    executed = _executed(settings)
    notebooks = {}
    if not settings.figures_in_git:  # a clone has no executed notebooks
        for path in executed:
            notebooks[path.stem] = os.path.relpath(path.with_suffix(".html"), settings.figures)
    return texts.render(
        "page.html.j2",
        title=f"Keypoint masks, {settings.run}",
        settings=settings,
        network=trainings.network_note(settings),
        chapters=chapters,
        shown=shown,
        of=len(captions.THESIS),
        card=captions.CARD,
        missing=missing,
        documents=_documents(settings),
        notebooks=notebooks,
        folder=os.path.relpath(settings.build / "notebooks", settings.figures),
        made=_made(executed, settings.figures_in_git),
    )


def _documents(settings: Settings) -> dict[str, "Content"]:
    """Return the texts of the folder docs that a page has, if links from it reach the folder."""
    documents: dict[str, Content] = {}
    if not settings.figures.is_relative_to(ROOT):
        return documents
    if settings.figures_in_git:
        documents["answer"] = _document("answer", settings)
    documents["own-masks"] = _document("own-masks", settings)
    return documents


def _document(name: str, settings: Settings) -> "Content":
    """Return a text of the folder docs for a page, without its title."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    # links are relative to docs
    folder = quote(os.path.relpath(ROOT / "docs", settings.figures))
    text = re.sub(r"\]\((?!\w+:|#)", f"]({folder}/", text)
    _, _, text = text.partition("\n")
    return _text(text)


def build_study(folder: Path, names: list[tuple[str, str]], **facts: Any) -> str:
    """Return the page of a study as HTML.

    names: (kind, name) of its files. facts: further values of the template.
    """
    artefacts = []
    for artefact, (kind, name) in itertools.product([*captions.OF_STUDIES, *captions.ADDED], names):
        # one artefact describes the figures of all sequences
        base, _, sequence = name.partition("-")
        if (kind, base) == (artefact["kind"], artefact["name"]):
            title = f"{artefact['title']} {sequence}".strip()
            artefacts.append(_describe(folder, artefact | {"name": name, "title": title}))
    return texts.render(
        "study.html.j2",
        title="A study of masks",
        artefacts=artefacts,
        notebooks={},
        made=_made(),
        **facts,
    )


def _describe(
    folder: Path,
    artefact: dict[str, Any],
    settings: Settings | None = None,
    numbers: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the values that the template needs to show an artefact, or to report it as missing.

    settings, numbers: of a run, from `tables.beside_the_thesis`; None for a study.
    """
    kind, name = artefact["kind"], artefact["name"]
    paths = [folder / f"{name}{ending}" for ending in ENDINGS[kind]]
    files = [path for path in paths if path.is_file()]
    content = Content()
    if files and kind == "text":
        content = _text(files[0].read_text(encoding="utf-8"))
    elif files and kind == "table" and files[0].suffix == ".csv":
        content = _table(files)
    there = bool(files) and (kind == "figure" or content.html is not None)
    number = _number(kind, name)
    identity = name
    if kind != "text" and number is None:
        identity = f"{kind}-{name}"
    makers = []
    if settings:
        makers = [notebook for notebook, names in captions.MADE_BY.items() if name in names]
    thesis = dict(artefact.get("thesis", ()))
    if thesis and settings and numbers is not None:
        _compare_with_thesis(thesis, settings, numbers.get(name))
    left_out = None
    if not there and settings and _is_left_out(artefact, settings):
        left_out = artefact["needs"]
    return artefact | {
        "id": identity,
        "number": number,
        "there": there,
        "content": content.html,
        "details": content.details,
        "rows": content.rows,
        "markdown": content.markdown,
        "files": [path.name for path in files],
        "makers": makers,
        "thesis": thesis,
        "opens": there and identity in OPENING,
        "left_out": left_out,
    }


class Content(NamedTuple):
    """What a page shows of a text or a table."""

    html: Markup | None = None
    details: Markup | None = None  # of a text: the part that the page folds
    rows: int = 0  # of a table
    markdown: str | None = None  # of a table that is short enough for the gallery


def _text(text: str) -> Content:
    """Return a text in Markdown; the page folds the part after the first heading."""
    first, _, rest = text.partition("\n## ")
    if not rest:
        return Content(texts.html(first))
    return Content(texts.html(first), texts.html(f"## {rest}"))


def _table(files: list[Path]) -> Content:
    """Return a table. files: its CSV file and, if it was written, its Markdown file."""
    table = tables.read(files[0])
    markdown = None
    if len(table) <= ROWS_SHOWN and len(files) > 1:
        markdown = files[1].read_text(encoding="utf-8")
    return Content(tables.html(table), rows=len(table), markdown=markdown)


def _number(kind: str, name: str) -> str | None:
    """Return the number in the thesis: figure_4_07 is Figure 4.7, figure_a_01 is Figure A.1."""
    if name not in captions.THESIS:
        return None
    _, chapter, count = name.split("_")
    return f"{kind.capitalize()} {chapter.upper()}.{int(count)}"


def _compare_with_thesis(
    thesis: dict[str, Any], settings: Settings, numbers: dict[str, Any] | None
) -> None:
    """Fill in what the thesis reports beside an artefact and what this run gives (see `captions`).

    numbers: of this run, or None if it has none.
    """
    fill = texts.TEMPLATES.from_string
    thesis["text"] = fill(thesis["text"]).render(captions.REPORTED)
    if numbers is None:
        thesis["here"] = False
    else:
        thesis["here"] = fill(thesis["here"]).render(numbers)
    is_embedded = {
        "runs": settings.kitti_is_embedded,
        "training": settings.cityscapes_is_embedded,
    }
    thesis["embedded"] = is_embedded.get(thesis["data"], False)


def _is_left_out(artefact: dict[str, Any], settings: Settings) -> bool:
    """Return whether a run does not make an artefact, since a variable that it needs is not set."""
    needs = artefact.get("needs")
    if not needs or not settings.uses_shipped_model:
        return False
    return needs != "KITTI_SEMANTIC" or not settings.kitti_semantic


def _made(executed: list[Path] | None = None, in_git: bool = False) -> dict[str, Any]:
    """Return the packages of the results.

    For a page outside git, also their machine, commit and day.
    """
    versions = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):  # a study needs no TensorFlow
            versions[name] = importlib.metadata.version(name)
    made: dict[str, Any] = {"packages": versions}
    if in_git:
        return made
    made["python"] = platform.python_version()
    made["machine"] = f"{platform.system()} {platform.machine()}"
    # --git-dir excludes a repository in a parent folder
    describe = ["git", f"--git-dir={ROOT / '.git'}", f"--work-tree={ROOT}", "describe"]
    describe += ["--always", "--dirty", "--exclude=*", "--abbrev=12"]
    with suppress(OSError, subprocess.CalledProcessError):
        answer = subprocess.run(describe, capture_output=True, text=True, check=True)
        made["commit"] = answer.stdout.strip()
    if executed:
        latest = max(path.stat().st_mtime for path in executed)
        made["day"] = f"{datetime.fromtimestamp(latest, UTC):%d %B %Y}"
    return made


def main() -> None:
    """Write the page of the run of the current settings."""
    settings = read_settings()
    update(settings)
    if note := trainings.network_note(settings):
        print(note)


if __name__ == "__main__":
    messages.run_main(main)
