"""The HTML of figures, tables and texts, and the page of a study, which needs no network."""

import importlib.metadata
import platform
import subprocess
from contextlib import suppress
from typing import Any

import mistune
import pandas as pd
from markupsafe import Markup

from keypoint_study.report import style, texts
from keypoint_study.report.style import Artefact
from thesis_repro.running.provenance import ROOT

PAGE = "index.html"
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


def page_of(artefacts: list[dict[str, Any]], **facts: Any) -> str:
    """Return the page of a study as HTML. artefacts: of `described`. facts: of the template."""
    compared = dict.fromkeys(facts["kinds"][source.kind] for source in facts["study"].sources)
    title = f"{' and '.join(compared).capitalize()}, compared with all keypoints"
    return texts.render(
        "study.html.j2", title=title, artefacts=artefacts, made=made_with(), **facts
    )


def described(artefact: Artefact, files: list[str]) -> dict[str, Any]:
    """Return the values that the template needs to show an artefact. files: their names."""
    content: Any = artefact.content
    values = {**artefact._asdict(), "files": files, "details": None, "rows": 0}
    if isinstance(content, pd.DataFrame):
        shown = "" if artefact.for_programs else style.markdown(content)
        return {**values, "kind": "table", "rows": len(content), "content": from_markdown(shown)}
    if isinstance(content, str):
        first, heading, rest = content.partition("\n## ")
        details = from_markdown(f"## {rest}") if heading else None
        return {**values, "kind": "text", "content": from_markdown(first), "details": details}
    return {**values, "kind": "figure"}


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text: str, level: int, **attributes: Any) -> str:
        # lower than the headings of the page
        return super().heading(text, max(4, level + 1), **attributes)


def from_markdown(text: str) -> Markup:
    """Convert Markdown to HTML. HTML tags in the Markdown are shown as text."""
    convert = mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])
    return Markup(convert(text))


def made_with() -> dict[str, Any]:
    """Return the packages, the Python, the machine and the commit of the results."""
    found = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):  # a study needs no TensorFlow
            found[name] = importlib.metadata.version(name)
    facts: dict[str, Any] = {
        "packages": found,
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
