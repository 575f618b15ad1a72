"""The HTML of figures, tables and texts, and the page of a study, which needs no network."""

import importlib.metadata
import json
import platform
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import mistune
from markupsafe import Markup

from thesis_repro.report import texts
from thesis_repro.running.settings import ROOT

PAGE = "index.html"
ENDINGS = {"figure": (".svg", ".webp", ".pdf"), "table": (".csv", ".md", ".tex"), "text": (".md",)}
# The figures, tables and texts of a study: dicts with kind ("figure", "table", "text"), name (of
# the files), title and caption.
ARTEFACTS = json.loads((Path(__file__).parent / "captions.json").read_text(encoding="utf-8"))
OPENING = ("findings", "figure-comparison", "table-summary")  # ids of those at the top of a page
ROWS_SHOWN = 36  # of a table; a longer one is linked
# packages that affect the numbers most
PACKAGES = (
    "tensorflow",
    "keras",
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
    "numpy",
)
# what only artefacts of the thesis have
NOT_OF_THESIS: dict[str, Any] = {"number": None, "makers": [], "thesis": {}, "left_out": None}


def build_study(folder: Path, names: list[tuple[str, str]], **facts: Any) -> str:
    """Return the page of a study as HTML.

    names: (kind, name) of its files. facts: further values of the template, and the study itself.
    """
    described = []
    for artefact in ARTEFACTS:
        for kind, name in names:
            # one artefact describes the figures of all sequences
            base, _, sequence = name.partition("-")
            if (kind, base) == (artefact["kind"], artefact["name"]):
                title = f"{artefact['title']} {sequence}".strip()
                described.append(describe(folder, artefact | {"name": name, "title": title}))
    compared = dict.fromkeys(facts["kinds"][source.kind] for source in facts["study"].sources)
    return texts.render(
        "study.html.j2",
        title=f"{' and '.join(compared).capitalize()}, compared with all keypoints",
        artefacts=described,
        notebooks={},
        made=made_with() | made_on(),
        **facts,
    )


def describe(folder: Path, artefact: dict[str, Any]) -> dict[str, Any]:
    """Return the values that a template needs to show an artefact, or to report it as missing."""
    kind, name = artefact["kind"], artefact["name"]
    paths = [folder / f"{name}{ending}" for ending in ENDINGS[kind]]
    files = [path for path in paths if path.is_file()]
    content = Content()
    if files and kind == "text":
        content = text_content(files[0].read_text(encoding="utf-8"))
    elif files and kind == "table" and files[0].suffix == ".csv":
        content = _table_content(files)
    there = bool(files) and (kind == "figure" or content.html is not None)
    identity = name
    if kind != "text":
        identity = f"{kind}-{name}"
    described = {
        "id": identity,
        "there": there,
        "content": content.html,
        "details": content.details,
        "rows": content.rows,
        "markdown": content.markdown,
        "files": [path.name for path in files],
        "opens": there and identity in OPENING,
    }
    return NOT_OF_THESIS | artefact | described


class Content(NamedTuple):
    """What a page shows of a text or a table."""

    html: Markup | None = None
    details: Markup | None = None  # of a text: the part that the page folds
    rows: int = 0  # of a table
    markdown: str | None = None  # of a table that is short enough to be shown


def text_content(text: str) -> Content:
    """Return a text in Markdown; the page folds the part after the first heading."""
    first, _, rest = text.partition("\n## ")
    if not rest:
        return Content(from_markdown(first))
    return Content(from_markdown(first), from_markdown(f"## {rest}"))


def _table_content(files: list[Path]) -> Content:
    """Return a table. files: its CSV file and its Markdown file."""
    text = files[1].read_text(encoding="utf-8")
    table = text.partition("\n\n")[0]  # without the data note
    rows = table.count("\n") - 1
    markdown = None
    if rows <= ROWS_SHOWN:
        markdown = text
    return Content(from_markdown(table), rows=rows, markdown=markdown)


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text: str, level: int, **attributes: Any) -> str:
        # lower than the headings of the page
        return super().heading(text, max(4, level + 1), **attributes)


def from_markdown(text: str) -> Markup:
    """Convert Markdown to HTML. HTML tags in the Markdown are shown as text."""
    convert = mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])
    return Markup(convert(text))


def made_with() -> dict[str, Any]:
    """Return the packages of the results, with their versions."""
    versions = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):  # a study needs no TensorFlow
            versions[name] = importlib.metadata.version(name)
    return {"packages": versions}


def made_on() -> dict[str, Any]:
    """Return the Python, the machine and the commit of the results."""
    facts = {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    # --git-dir excludes a repository in a parent folder
    describe = ["git", f"--git-dir={ROOT / '.git'}", f"--work-tree={ROOT}", "describe"]
    describe += ["--always", "--dirty", "--exclude=*", "--abbrev=12"]
    with suppress(OSError, subprocess.CalledProcessError):
        answer = subprocess.run(describe, capture_output=True, text=True, check=True)
        facts["commit"] = answer.stdout.strip()
    return facts
