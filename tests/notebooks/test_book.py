"""The book of an executed run: every page, without a warning, readable without a network."""

import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from bs4 import BeautifulSoup
from cells import NOTEBOOKS, cells
from executing import run_of

import thesis_repro as tr
from thesis import book, gallery
from thesis.run_settings import read_settings

NOT_RUN = NOTEBOOKS[1]
pytestmark = pytest.mark.torture


@pytest.fixture(scope="module")
def settings(executed, tmp_path_factory):
    """Those of a copy of the executed run."""
    folder = tmp_path_factory.mktemp("book")
    for part in ("notebooks", "figures"):
        place = Path("build", "embedded-smoke", part)
        shutil.copytree(executed / place, folder / place)
    (folder / "build/embedded-smoke/notebooks" / NOT_RUN).unlink()
    return read_settings(run_of(folder))


@pytest.fixture(scope="module")
def pages(settings):
    """{name: page} of the lessons' book, which is written without a warning."""
    gallery.update(settings)
    assert book.build(settings) == 0
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
    was_run = "Not run with the data" not in page.get_text()
    assert was_run == (name != NOT_RUN) == bool(page.select(".cell_output img"))
    assert was_run == bool(page.select(".cell_output pre"))
    assert name in page.get_text() and "localhost" not in str(page)


def test_pictures_and_what_scrolls_can_be_reached_and_lists_have_names(pages):
    for name, page in pages.items():
        assert [each for each in page.select("article img") if not each.find_parent("a")] == [], (
            name
        )
        scrolls = page.select(".pst-scrollable-table-container, .text_html, .equation")
        assert all(each.get("tabindex") == "0" for each in scrolls), name
        unnamed = [each for each in page.find_all("summary") if not each.get_text(strip=True)]
        assert all(each.get("aria-label") for each in unnamed), name
        heads = [int(each.name[1]) for each in page.select("article :is(h1, h2, h3, h4, h5)")]
        assert all(after <= before + 1 for before, after in zip(heads, heads[1:])), name
        assert not page.select("article .cell_output span[class^=ansi]"), name


def test_every_link_of_a_lesson_leads_to_a_page_or_a_file(pages, settings):
    html = settings.build / "book" / "html"
    for name, page in pages.items():
        for link in page.select("article a[href]") if name.startswith("notebooks") else ():
            path = unquote(link["href"].partition("#")[0])
            assert re.match(r"$|\w+:", path) or (html / name).parent.joinpath(path).exists(), path


def test_pages_have_titles_and_one_explains_each_public_name(pages):
    titles = {name: page.h1.get_text().rstrip("#") for name, page in pages.items() if page.h1}
    assert titles["figures/table_4_1"] == "Best dilation width"
    assert titles["figures/kitti_excerpts/table_4_1"] == "Best dilation width (real frames)"
    assert len({*titles.values()}) == len(titles)
    assert "version = {[" not in pages["index"].get_text()
    explained = {each["id"].split(".")[1] for each in pages["docs/reference"].select("dt[id]")}
    assert {*tr.__all__} - {"THESIS", "metrics", "Masks"} <= explained
