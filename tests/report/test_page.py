"""The page of a run, on a figures folder written by hand."""

import os
import platform
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import nbformat
import pytest

from thesis_repro.report import captions, page
from thesis_repro.settings import ROOT, read_settings

SVG = '<svg height="100pt" width="200pt" xmlns="http://www.w3.org/2000/svg"><path d="M0 0"/></svg>'
CSV = 'sequence,RMSE (m),change (%),"change (%), thesis"\n00,0.5,-3.25,1.0\n01,12.0,4.5,\nsequences improved,,1.0,0.0\n'
VOID = {"img", "meta"}
ARTEFACTS = [*(one for of_chapter in captions.CHAPTERS.values() for one in of_chapter), *captions.ADDED]


class Reader(HTMLParser):
    """The elements of a page in order as (tag, attributes); fails where tags are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert not self.open
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def of(self, tag, attribute):
        return [attributes[attribute] for name, attributes in self.elements if name == tag and attribute in attributes]


@pytest.fixture
def run(tmp_path):
    """A run in a folder with a space in its name: every artefact, and one executed notebook."""
    settings = read_settings({"THESIS_REPRO_BUILD": str(tmp_path / "my build"),
                              "THESIS_REPRO_FIGURES": str(tmp_path / "figures")})
    settings.figures.mkdir()
    for artefact in ARTEFACTS:
        for ending in page.ENDINGS[artefact["kind"]][:1 if artefact["kind"] == "figure" else None]:
            text = {".svg": SVG, ".csv": CSV, ".md": "**What** <b>it</b> shows"}[ending]
            (settings.figures / f"{artefact['name']}{ending}").write_text(text)
    executed = settings.build / "notebooks" / "08_results.ipynb"
    executed.parent.mkdir(parents=True)
    cell = nbformat.v4.new_code_cell('keep(figure, "figure_4_06")', execution_count=1,
                                     outputs=[nbformat.v4.new_output("stream", text="a number: 42")])
    nbformat.write(nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_markdown_cell("# Results"), cell],
        metadata={"language_info": {"name": "python", "version": "3.11.99"}}), executed)
    os.utime(executed, (1709210096,) * 2)  # 29 February 2024
    return SimpleNamespace(settings=settings, page=settings.figures / "index.html", executed=executed)


def read(run):
    page.update(run.settings)
    return Reader(run.page.read_text())


def test_all_41_in_the_order_of_the_thesis_then_the_projects_own(run):
    shown = read(run)
    figures = [one["name"] for one in ARTEFACTS if one["kind"] == "figure"]
    assert shown.of("img", "src") == [f"{name}.svg" for name in figures]
    assert len([name for name in figures if name in captions.THESIS]) == 36 and len(captions.THESIS) == 41
    ids = [attributes["id"] for tag, attributes in shown.elements if tag in ("figure", "section")]
    assert ids == ["findings", *captions.THESIS, *(f"{one['kind']}-{one['name']}" for one in captions.ADDED
                                                   if one["kind"] != "text")]
    tables = [attributes for tag, attributes in shown.elements if tag == "table"]
    assert len(tables) == sum(one["kind"] == "table" for one in ARTEFACTS)
    assert captions.THESIS.index("table_4_1") == captions.THESIS.index("figure_4_10") + 1
    assert "41 of 41" in shown.text and "Missing" not in shown.text and all(shown.of("img", "alt"))


def test_missing_ones_are_named_with_the_notebook_that_makes_them(run):
    for name in ("figure_4_06.svg", "table_3_2.csv", "findings.md"):
        (run.settings.figures / name).unlink()
    shown = read(run)
    assert "39 of 41" in shown.text and "figure_4_06.svg" not in shown.of("img", "src")
    links = shown.of("a", "href")
    assert all(links.count(f"#{name}") == 2 for name in ("table_3_2", "figure_4_06", "findings"))
    assert "Notebook 08_results makes it" in shown.text


def test_every_link_of_the_page_leads_somewhere(run):
    shown = read(run)
    ids = {attributes["id"] for _, attributes in shown.elements if "id" in attributes}
    links = shown.of("a", "href") + shown.of("img", "src")
    assert any("08_results.html" in link for link in links) and "#top" in links
    for link in links:
        assert link[1:] in ids if link.startswith("#") else (run.settings.figures / unquote(link)).is_file(), link


def test_nothing_is_loaded_from_elsewhere_and_no_folder_of_the_machine_is_named(run):
    read(run)
    for path in (run.page, run.executed.with_suffix(".html")):
        text = path.read_text()
        shown = Reader(text)
        assert "script" not in {tag for tag, _ in shown.elements}
        assert not re.search(r"https?:|url\(|@import|file:", text)
        assert str(ROOT) not in text and str(run.settings.figures.parent) not in text


def test_the_page_in_git_says_nothing_of_the_machine_or_the_day_and_links_to_no_build(run):
    text = read(run).text
    assert "29 February 2024" in text and platform.python_version() in text and "tensorflow 2." in text
    in_git = replace(run.settings, figures=ROOT / "figures")  # read, not written
    before = page.build(in_git)
    assert platform.python_version() not in before.replace("tensorflow", "") and "2024" not in before
    os.utime(run.executed, (1900000000,) * 2)
    assert page.build(in_git) == before and "2030" in page.build(run.settings)
    shown = Reader(before)
    links = [link for link in shown.of("a", "href") + shown.of("img", "src") if not link.startswith("#")]
    assert len(links) > 80 and not [link for link in links if "/" in link and link != page.EVIDENCE]
    assert str(Path("my build", "embedded-demo", "notebooks")) in shown.text


def test_hostile_names_and_texts_stay_text(run, tmp_path):
    attack = '<img src=x onerror="alert(1)">\'&'
    kitti = tmp_path / f"kitti{attack}"
    kitti.mkdir()
    settings = replace(run.settings, kitti=kitti, kitti_is_embedded=False, run=f"run{attack}")
    (settings.figures / "table_4_2.csv").write_text(f'sequence,"{attack.replace(chr(34), chr(34) * 2)}"\n<script>,1\n')
    (settings.figures / "findings.md").write_text(f"# {attack}\n\n[a](javascript:alert(1)) <script>alert(1)</script>")
    run.executed.rename(run.executed.with_name(f"09{attack}.ipynb".replace("/", "")))
    page.update(settings)
    text = run.page.read_text()
    shown = Reader(text)
    assert not {"script", "onerror"} & {name for tag, attributes in shown.elements for name in (tag, *attributes)}
    assert "javascript" not in "".join(shown.of("a", "href")) and "x" not in shown.of("img", "src")
    assert shown.text.count(attack) >= 5  # the run, the folder, the notebook, the table's header, the text
    for link in shown.of("a", "href"):
        if not link.startswith("#"):
            assert (settings.figures / unquote(link)).is_file(), link


@pytest.mark.parametrize("kitti, cityscapes", [(True, True), (True, False), (False, True), (False, False)])
def test_the_embedded_world_is_named_at_the_top_where_it_was_used(run, tmp_path, kitti, cityscapes):
    environment = {f"THESIS_REPRO_{name}": str(tmp_path) for name, own in (("KITTI", not kitti),
                                                                         ("CITYSCAPES", not cityscapes)) if own}
    settings = read_settings(environment | {"THESIS_REPRO_BUILD": str(tmp_path / "b"),
                                            "THESIS_REPRO_FIGURES": str(tmp_path / "f")})
    settings.figures.mkdir(parents=True)
    shown = Reader(page.build(settings))
    assert ("note" in shown.of("p", "class")) == (kitti or cityscapes)
    assert shown.text.count("Not comparable with the embedded world") == 2 * kitti + cityscapes  # 4.7, 4.17; 4.1
    # without training, what would show it is left out and not missed
    missing = shown.text[shown.text.index("Missing:"):shown.text.index("What was run")]
    assert ("Figure 4.1," in missing) == ("Left out" not in shown.text) == (kitti or not cityscapes)


def test_a_table_has_the_numbers_of_its_file(run):
    text = read(run) and run.page.read_text()
    table = re.search(r'<figure id="table_4_2".*?</figure>', text, re.DOTALL)[0]
    rows = [re.findall(r"<t[dh]>(.*?)</t[dh]>", row) for row in table.split("<tr")[2:]]
    assert rows == [["00", "0.5", "-3.25", "1"], ["01", "12.0", "4.50", ""],
                    ["sequences improved", "", "1.00", "0"]]


def test_the_page_is_made_anew_and_of_notebooks_those_that_have_changed(run):
    html = run.executed.with_suffix(".html")
    page.update(run.settings)
    first = html.stat().st_mtime_ns
    (run.settings.figures / "figure_4_06.svg").unlink()
    (run.settings.figures / "table_4_1.csv").write_text("sequence,frames\n00,77\n")
    page.update(run.settings)
    assert "40 of 41" in run.page.read_text() and ">77<" in run.page.read_text()
    assert html.stat().st_mtime_ns == first
    run.executed.write_text(run.executed.read_text().replace("a number: 42", "a number: 43"))
    os.utime(run.executed, ns=(first + 10**9,) * 2)
    page.update(run.settings)
    assert "a number: 43" in html.read_text()


def test_thesis_numbers_stand_beside_those_of_the_run(run):
    (run.settings.build / "model").mkdir()
    (run.settings.build / "model" / "history.csv").write_text(
        "epoch,loss,f1-score,iou_score,val_loss,val_f1-score,val_iou_score\n"
        "1,0.9,0.1,0.1,0.8,0.21,0.2\n2,0.7,0.3,0.2,0.9,0.2,0.1\n")
    (run.settings.figures / "timings").mkdir()
    (run.settings.figures / "timings" / "seconds.csv").write_text(
        "sequence,method,dilation_width,seconds\n"
        "00,baseline,,4\n01,baseline,,6\n00,masked,1,4\n01,masked,1,4\n00,masked,2,11\n")
    (run.settings.figures / "table_4_1.csv").write_text("sequence,mean keypoints\n00,500\n01,300\n")
    text = read(run).text
    assert "Here: 4.0 to 6.7 times fewer" in text and "gives 2.0 to 4.1 times fewer than 2000" in text
    assert "Thesis, Cityscapes: 24 epochs, the best was 19; train loss 0.32" in text
    assert "Here: 2 epochs, the best was 1; train loss 0.90, F1 0.10, IoU 0.10; validation loss 0.80, F1 0.21" in text
    assert "5 to 10 % of the time saved." in text and "Here: -10 to 20 % of the time saved" in text
    assert "15,337,571 parameters" in text


def test_a_study_has_a_page_of_what_it_left(tmp_path):
    for name, text in (("comparison.svg", SVG), ("comparison.csv", CSV), ("findings.md", "**It** <script>shows")):
        (tmp_path / name).write_text(text)
    study = SimpleNamespace(kitti=Path("kitti"), sources=[], tested=10, estimators=["refined"], repetitions=3)
    html = page.build_study(
        tmp_path, {("figure", "comparison"), ("table", "comparison"), ("text", "findings")}, study=study, embedded=True,
        warnings=(), kinds={}, estimators={"refined": "refined estimator"}, line_width=10, changed={}, widths=[10],
        frames={"00": 9})
    shown = Reader(html)
    assert shown.of("img", "src") == ["comparison.svg"] and "12.0" in shown.text
    assert [attributes["id"] for tag, attributes in shown.elements if tag in ("figure", "section")] == [
        "findings", "figure-comparison", "table-comparison"]
    assert "embedded world" in shown.text and "script" not in {tag for tag, _ in shown.elements}
