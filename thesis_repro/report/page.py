"""The page with all tables and figures of a run or a study: index.html beside them. It needs no
network or server. README.md beside it is a gallery of the same, for reading in a repository.

`python -m thesis_repro.report.page` writes the page, and converts executed notebooks to HTML.
"""

import importlib.metadata
import itertools
import os
import platform
import re
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from thesis_repro.report import captions, tables, texts, trainings
from thesis_repro.running import console, results
from thesis_repro.running.files import listed, write_text
from thesis_repro.running.settings import ROOT, Settings, read_settings

PAGE, GALLERY = "index.html", "README.md"
ENDINGS = {"figure": (".svg", ".webp", ".pdf"), "table": (".csv", ".md", ".tex"), "text": (".md",)}
ROWS_SHOWN = 36  # the gallery only links to longer tables
# ids of the artefacts at the top of a page
OPENING = ("figure_4_05", "findings", "figure-comparison", "table-summary")
# packages that affect the numbers most
PACKAGES = ("tensorflow", "keras", *results.OPENCV, "numpy")


def update(settings: Settings) -> None:
    """Write the page of a run, and the HTML of each executed notebook that is newer than its HTML.

    Deletes temporary files of killed runs. Raises InputError if another run uses the folder.
    """
    with results.claimed(settings.build / "notebooks"):
        results.sweep(settings.build)
        # copied from the default run if their notebooks were not executed
        for name in captions.CONSTANT:
            for path in (ROOT / "figures").glob(f"{name}.*"):
                if not (settings.figures / path.name).exists():
                    write_text(settings.figures / path.name, path.read_text(encoding="utf-8"))
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


def _executed(settings: Settings) -> list[Path]:
    return listed(settings.build / "notebooks", "*.ipynb")


def notebook_html(path: Path, page: Path) -> str:
    """Convert an executed notebook to HTML with a link to the page."""
    import nbformat  # these are slow to import, and seldom needed
    from latex2mathml.converter import convert
    from nbconvert import HTMLExporter

    read = nbformat.read(path, as_version=4)
    for cell in read.cells:
        if cell.cell_type == "markdown":  # browsers show MathML without scripts
            cell.source = re.sub(
                r"\$\$(.+?)\$\$",
                lambda equation: convert(equation[1], display="block"),
                cell.source,
                flags=re.DOTALL,
            )
    # nbconvert's complete pages load scripts from the network, but the basic template does not
    content, resources = HTMLExporter(
        template_name="basic",
        embed_images=True,
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        exclude_anchor_links=True,
    ).from_notebook_node(read)
    return texts.render(
        "notebook.html.j2",
        title=path.stem,
        content=Markup(content),
        style=Markup("\n".join(resources["inlining"]["css"])),
        page=os.path.relpath(page, path.parent),
    )


def _chapters(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Return the described artefacts of each chapter, {title: artefacts}."""
    numbers = tables.beside_the_thesis(settings)
    return {
        title: [_describe(settings.figures, artefact, settings, numbers) for artefact in artefacts]
        for title, artefacts in (captions.CHAPTERS | {"Beyond the thesis": captions.ADDED}).items()
    }


def build(settings: Settings) -> str:
    """Return the page of a run as HTML, made from the files in its folders."""
    chapters = _chapters(settings)
    executed, artefacts = _executed(settings), list(itertools.chain(*chapters.values()))
    return texts.render(
        "page.html.j2",
        title=f"Keypoint masks, {settings.run}",
        settings=settings,
        network=trainings.network_note(settings),
        chapters=chapters,
        shown=sum(artefact["there"] and artefact["number"] is not None for artefact in artefacts),
        of=len(captions.THESIS),
        card=captions.CARD,
        missing=[
            artefact for artefact in artefacts if not artefact["there"] and not artefact["left_out"]
        ],
        documents={
            name: _document(name, settings)
            for name in (("answer",) if settings.figures_in_git else ()) + ("own-masks",)
            if settings.figures.is_relative_to(ROOT)
        },
        notebooks={
            path.stem: os.path.relpath(path.with_suffix(".html"), settings.figures)
            for path in executed
        },
        folder=os.path.relpath(settings.build / "notebooks", settings.figures),
        made=_made(executed, settings.figures_in_git),
    )


def _document(name: str, settings: Settings) -> tuple[Markup, Markup]:
    """Return a text of the folder docs for a page: its first paragraph and the rest, as HTML."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    # links are relative to docs
    folder = quote(os.path.relpath(ROOT / "docs", settings.figures))
    _, first, rest = re.sub(r"\]\((?!\w+:|#)", f"]({folder}/", text).split("\n\n", 2)
    return texts.html(first), texts.html(rest)


def build_study(folder: Path, names: list[tuple[str, str]], **facts: Any) -> str:
    """Return the page of a study as HTML. names: (kind, name) of its files. facts: further
    values of the template.
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
    """Return the values that the template needs to show a table, figure or text, or to report
    it as missing.
    """
    kind, name = artefact["kind"], artefact["name"]
    files = [path for ending in ENDINGS[kind] if (path := folder / f"{name}{ending}").is_file()]
    content, details, rows, markdown = None, None, 0, None
    if files and kind == "text":  # the page folds the part after the first heading
        content, _, details = files[0].read_text(encoding="utf-8").partition("\n## ")
        content, details = texts.html(content), texts.html(f"## {details}") if details else None
    elif kind == "table" and files and files[0].suffix == ".csv":
        table = tables.read(files[0])
        content, rows = tables.html(table), len(table)
        if len(table) <= ROWS_SHOWN and len(files) > 1:
            markdown = files[1].read_text(encoding="utf-8")
    there = bool(files) and (kind == "figure" or content is not None)
    number = None
    if name in captions.THESIS:  # figure_4_07 is Figure 4.7, figure_a_01 is Figure A.1
        _, chapter, count = name.split("_")
        number = f"{kind.capitalize()} {chapter.upper()}.{int(count)}"
    thesis = dict(artefact.get("thesis", ()))
    if thesis and settings and numbers is not None:
        fill = texts.TEMPLATES.from_string
        thesis["text"] = fill(thesis["text"]).render(captions.REPORTED)
        thesis["here"] = name in numbers and fill(thesis["here"]).render(numbers[name])
        thesis["embedded"] = (
            settings.kitti_is_embedded
            if thesis["data"] == "runs"
            else thesis["data"] == "training" and settings.cityscapes_is_embedded
        )
    needs = artefact.get("needs")
    given = (
        not needs
        or not settings
        or not settings.uses_shipped_model
        or (needs == "KITTI_SEMANTIC" and settings.kitti_semantic)
    )
    identity = name if number or kind == "text" else f"{kind}-{name}"
    return artefact | {
        "id": identity,
        "number": number,
        "there": there,
        "content": content,
        "details": details,
        "rows": rows,
        "markdown": markdown,
        "files": [path.name for path in files],
        "makers": [
            notebook for notebook, names in captions.MADE_BY.items() if settings and name in names
        ],
        "thesis": thesis,
        "opens": there and identity in OPENING,
        "left_out": needs if not given and not there else None,
    }


def _made(executed: list[Path] | None = None, in_git: bool = False) -> dict[str, Any]:
    """Return the packages and, for a page outside git, the machine, commit and day of the
    results.
    """
    versions = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):  # a study needs no TensorFlow
            versions[name] = importlib.metadata.version(name)
    made: dict[str, Any] = {"packages": versions}
    if in_git:
        return made
    made |= {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    with suppress(OSError, subprocess.CalledProcessError):
        made["commit"] = subprocess.run(  # --git-dir excludes a repository in a parent folder
            [
                "git",
                f"--git-dir={ROOT / '.git'}",
                f"--work-tree={ROOT}",
                "describe",
                "--always",
                "--dirty",
                "--exclude=*",
                "--abbrev=12",
            ],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    if executed:
        latest = max(path.stat().st_mtime for path in executed)
        made["day"] = f"{datetime.fromtimestamp(latest, UTC):%d %B %Y}"
    return made


def main() -> None:
    settings = read_settings()
    update(settings)
    if note := trainings.network_note(settings):
        print(note)


if __name__ == "__main__":
    console.run_main(main)
