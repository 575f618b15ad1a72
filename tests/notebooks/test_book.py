"""The book of an executed run: every page, without a warning, readable without a network."""

import json
import re
import shutil
from pathlib import Path

import pytest
from bs4 import BeautifulSoup
from cells import NOTEBOOKS, cells
from executing import run_of

from thesis import book, gallery
from thesis.settings import read_settings

pytestmark = [pytest.mark.notebooks, pytest.mark.slow]


@pytest.fixture(scope="module")
def settings(executed, tmp_path_factory):
    """Those of a copy of the executed run."""
    folder = tmp_path_factory.mktemp("book")
    for part in ("notebooks", "figures"):
        place = Path("build", "embedded-smoke", part)
        shutil.copytree(executed / place, folder / place)
    return read_settings(run_of(folder))


@pytest.fixture(scope="module")
def pages(settings):
    """{name: page} of the lessons' book, which is written without a warning."""
    gallery.update(settings)
    assert book.build(settings, "--fail-on-warning", "--keep-going") == 0
    html = settings.build / "book" / "html"
    return {
        str(path.relative_to(html).with_suffix("")): BeautifulSoup(path.read_text(), "html.parser")
        for path in html.rglob("*.html")
        if "_static" not in path.parts
    }


def test_nothing_is_loaded_from_the_network(pages):
    for name, page in pages.items():
        loaded = [each.get("src", "") for each in page.find_all(["script", "img", "iframe"])]
        loaded += [each["href"] for each in page.find_all("link")]
        assert not [link for link in loaded if re.match(r"https?:|//", link)], name


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_lesson_has_its_outputs_equations_and_a_link_to_the_lab(pages, name):
    page = pages[f"notebooks/{Path(name).stem}"]
    equations = sum(text.count("$$") // 2 for text in cells(name, "markdown").values())
    assert len(page.select("div.equation math")) == equations and "$$" not in page.get_text()
    assert page.select(".cell_output img") and page.select(".cell_output pre")
    assert page.find("a", href=f"http://localhost:8888/lab/tree/{name}")


def test_only_what_changed_is_read_again(pages, settings):
    read = settings.build / "book" / "read"
    times = {path: path.stat().st_mtime_ns for path in read.rglob("*.doctree")}
    path = settings.build / "notebooks" / NOTEBOOKS[0]
    notebook = json.loads(path.read_text())
    notebook["cells"][0]["source"] += "\nchanged"
    path.write_text(json.dumps(notebook))
    assert book.build(settings) == 0
    changed = [path.stem for path, time in times.items() if path.stat().st_mtime_ns != time]
    assert changed == ["01_load_images_and_labels"]
