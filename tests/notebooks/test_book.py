"""The book of an executed run: every page, without a warning, readable without a network."""

import json
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from bs4 import BeautifulSoup
from cells import NOTEBOOKS, cells
from executing import run_of

from thesis import book, gallery
from thesis.settings import ROOT, read_settings

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


def test_the_first_page_counts_the_claims_and_has_a_card_for_each_lesson(pages):
    claims = (ROOT / "figures/kitti_excerpts/claims.md").read_text()
    table = pages["index"].find("table")
    counts = {row.find_all("td")[1].get_text(): int(row.td.get_text()) for row in table("tr")[1:]}
    words = [line.split(" | ")[3] for line in claims.splitlines() if line.count(" | ") == 4]
    assert counts == {word: words.count(word) for word in counts} and sum(counts.values()) >= 25
    cards = [card.find("img").find_parent("a")["href"] for card in pages["index"].select(".card")]
    assert cards == [f"notebooks/{Path(name).stem}.html" for name in NOTEBOOKS]


def test_only_what_changed_is_read_again_and_what_was_not_run_says_so(pages, settings):
    read = settings.build / "book" / "read"
    (settings.build / "notebooks" / NOTEBOOKS[1]).unlink()
    times = {path: path.stat().st_mtime_ns for path in read.rglob("*.doctree")}
    path = settings.build / "notebooks" / NOTEBOOKS[0]
    notebook = json.loads(path.read_text())
    notebook["cells"][0]["source"] += "\nchanged"
    path.write_text(json.dumps(notebook))
    assert book.build(settings) == 0
    changed = [path.stem for path, time in times.items() if path.stat().st_mtime_ns != time]
    assert sorted(changed) == ["01_load_images_and_labels", "02_augmentation"]
    told = [
        "Not run with the data" in (settings.build / f"book/html/notebooks/{name}.html").read_text()
        for name in sorted(changed)
    ]
    assert told == [False, True]


def test_a_book_of_other_files_is_written_anew(tmp_path):
    (tmp_path / "one").write_text("one")
    parts, page = {Path("docs/one"): tmp_path / "one"}, tmp_path / "book" / "html" / "other"
    for names, stays in ((parts, False), (parts, True), ({Path("two"): tmp_path / "one"}, False)):
        page.parent.mkdir(parents=True, exist_ok=True)
        page.touch()
        book._arrange(names, tmp_path / "book")
        assert page.exists() == stays
        source = tmp_path / "book" / "source"
        assert {path for path in names if (source / path).is_file()} == set(names)
