"""The page of a run, on a figures folder of made-up files."""

import html
import json
import os
import platform
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import nbformat
import pandas as pd
import pytest

from thesis import captions, page
from thesis_repro.report import page as report_page
from thesis_repro.report import tables
from thesis_repro.running.settings import ROOT, read_settings

SVG = '<svg height="100pt" width="200pt" xmlns="http://www.w3.org/2000/svg"><path d="M0 0"/></svg>'
CSV = 'sequence,RMSE (m),change (%),"change (%), thesis"\n00,0.5,-3.25,1.0\n01,12.0,4.5,\nsequences improved,,1.0,0.0\n'
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
VOID = {"img", "meta"}
ARTEFACTS = [
    *(artefact for chapter in captions.CHAPTERS.values() for artefact in chapter),
    *captions.ADDED,
]


class Reader(HTMLParser):
    """The text of a page and its elements as (tag, attributes).

    Fails if tags are not closed in order.
    """

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert not self.open
        self.text = " ".join(self.text.split())
        self.ids = {attributes["id"] for _, attributes in self.elements if "id" in attributes}

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def values(self, tag, attribute):
        return [
            attributes[attribute]
            for name, attributes in self.elements
            if name == tag and attribute in attributes
        ]


@pytest.fixture
def run(tmp_path):
    """A run in a folder with a space in its name: every artefact, and one executed notebook."""
    settings = read_settings(
        {
            "THESIS_REPRO_BUILD": str(tmp_path / "my build"),
            "THESIS_REPRO_FIGURES": str(tmp_path / "figures"),
        }
    )
    settings.figures.mkdir()
    for artefact in ARTEFACTS:
        for ending in report_page.ENDINGS[artefact["kind"]][
            : 1 if artefact["kind"] == "figure" else None
        ]:
            text = {".svg": SVG, ".csv": CSV}.get(ending, "What it shows")
            (settings.figures / f"{artefact['name']}{ending}").write_text(text)
    executed = settings.build / "notebooks" / "08_results.ipynb"
    executed.parent.mkdir(parents=True)
    cell = nbformat.v4.new_code_cell(
        'keep(figure, "figure_4_06")',
        execution_count=1,
        outputs=[nbformat.v4.new_output("stream", text="a number: 42")],
    )
    nbformat.write(
        nbformat.v4.new_notebook(
            cells=[nbformat.v4.new_markdown_cell("# Results\n\n$$x^2$$"), cell],
            metadata={"language_info": {"name": "python", "version": "3.11.99"}},
        ),
        executed,
    )
    os.utime(executed, (1709210096,) * 2)  # 29 February 2024
    return SimpleNamespace(
        settings=settings, page=settings.figures / "index.html", executed=executed
    )


def read(run):
    page.update(run.settings, run.settings.figures)
    return Reader(run.page.read_text())


def test_the_answer_comes_first_and_41_artefacts_in_the_order_of_the_thesis(run):
    shown = read(run)
    ids = [
        attributes["id"]
        for tag, attributes in shown.elements
        if tag in ("figure", "section") or attributes.get("id") == "notebooks"
    ]
    added = [f"{artefact['kind']}-{artefact['name']}" for artefact in captions.ADDED[1:]]
    added.remove(page.OPENING[2])
    in_order = [name for name in captions.THESIS if name not in page.OPENING]
    assert ids == [*page.OPENING[:3], *in_order, *added, "notebooks"] and len(captions.THESIS) == 41
    images = [f"{artefact['name']}.svg" for artefact in ARTEFACTS if artefact["kind"] == "figure"]
    assert sorted(shown.values("img", "src")) == sorted(images) and all(shown.values("img", "alt"))
    assert "41 of 41" in shown.text and shown.text.count("What it shows") == 1


PROBE = """<iframe src="index.html" style="width: 390px; border: 0"></iframe>
<iframe src="index.html" style="width: 1400px; border: 0"></iframe><pre></pre><script>onload = () => {
const faults = [];
for (const frame of document.querySelectorAll("iframe")) {
    const page = frame.contentDocument, width = page.documentElement.clientWidth;
    page.querySelectorAll("details").forEach(details => { details.open = true; });
    if (page.documentElement.scrollWidth > width) faults.push(`wider than ${width}`);
    for (const image of page.images)
        if (!image.naturalWidth) faults.push(`no image ${image.getAttribute("src")} at ${width}`);
        else if (image.width < Math.min(image.naturalWidth, image.closest("figure, p").clientWidth) - 1)
            faults.push(`small image ${image.getAttribute("src")} at ${width}`);
    for (const link of page.querySelectorAll('a[href^="#"]'))
        if (!page.getElementById(link.hash.slice(1))) faults.push(`dead link ${link.hash} at ${width}`);
    const blocks = [...page.querySelectorAll("h1, h2, h3, h4, p, figcaption, dl, ul, summary, img, .scroll")];
    const boxes = blocks.map(block => { // its text may leave its box
        const range = page.createRange();
        range.selectNodeContents(block);
        return (block.matches("img, .scroll") ? block : range).getBoundingClientRect(); });
    blocks.forEach((block, i) => blocks.slice(0, i).forEach((other, j) => {
        const [a, b] = [boxes[i], boxes[j]], apart = block.closest("nav") || other.closest("nav");
        if (!apart && !other.contains(block) && Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
            && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)
            faults.push(`${block.textContent.slice(0, 40)} on ${other.textContent.slice(0, 40)} at ${width}`); }));
}
document.querySelector("pre").textContent = JSON.stringify(faults); }</script>"""


def faults_in_a_browser(folder, scratch):
    """Faults of a page at 390 and 1400 pixels, unfolded.

    They are a page that is too wide, missing or needlessly small images, dead links and overlapping
    texts.
    """
    (folder / "probe.html").write_text(PROBE)  # a window cannot be as narrow
    dumped = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--dump-dom",
            "--allow-file-access-from-files",
            "--window-size=1600,900",
            f"--user-data-dir={scratch}",
            (folder / "probe.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return json.loads(html.unescape(re.search("<pre>(.*?)</pre>", dumped.stdout, re.DOTALL)[1]))


@pytest.mark.skipif(not BROWSER, reason="no Chromium on this machine")
def test_a_browser_shows_the_page_of_the_repository_without_faults(tmp_path):
    figures = tmp_path / "figures"
    shutil.copytree(ROOT / "figures", figures)
    (figures / report_page.PAGE).write_text(page.build(replace(read_settings({}), build=tmp_path)))
    assert faults_in_a_browser(figures, tmp_path / "scratch") == []
    folded = (
        '<p style="height: 0">Folded <img src="none.svg"></p><p>over <a href="#nowhere">it</a></p>'
    )
    (figures / report_page.PAGE).write_text(
        f'<details>{folded}</details><div style="width: 900px">wide</div>'
        '<p><img src="figure_4_05.webp" width="100"></p>'
    )
    faults = faults_in_a_browser(figures, tmp_path / "scratch")
    assert {fault.split(" at ")[0] for fault in faults} >= {
        "wider than 390",
        "small image figure_4_05.webp",
        "no image none.svg",
        "dead link #nowhere",
    }
    assert any(fault.startswith("over it on Folded") for fault in faults)


def test_missing_artefacts_are_listed_unless_their_data_were_not_given(run, tmp_path):
    for name in (
        "figure_4_06.svg",
        "table_3_2.csv",
        "figure_3_05.svg",
        "findings.md",
        "domain_gap.csv",
    ):
        (run.settings.figures / name).unlink()
    shown = read(run)
    assert (run.settings.figures / "table_3_2.csv").read_bytes() == (
        ROOT / "figures" / "table_3_2.csv"
    ).read_bytes()
    assert "39 of 41" in shown.text and "figure_4_06.svg" not in shown.values("img", "src")
    assert (
        shown.values("a", "href").count("#figure_3_05") == 2
        and "Notebook 08_results makes it" in shown.text
    )
    on_real_frames = replace(run.settings, kitti_is_embedded=False)
    text = page.build(on_real_frames)
    missing = re.search(r'<p class="missing">Missing:(.*?)</p>', text, re.DOTALL)[1]
    assert (
        "#figure_4_06" in missing and "figure_3_05" not in missing and "domain_gap" not in missing
    )
    assert text.count("CITYSCAPES=/path") == text.count("KITTI_SEMANTIC=/path") == 1
    assert "KITTI_SEMANTIC=/path" not in page.build(
        replace(on_real_frames, kitti_semantic=tmp_path)
    )


def test_each_artefact_is_written_by_the_notebooks_that_are_named():
    written = {name for names in captions.MADE_BY.values() for name in names}
    assert written == {artefact["name"] for artefact in ARTEFACTS}
    for notebook, names in captions.MADE_BY.items():
        code = (ROOT / "notebooks" / f"{notebook}.ipynb").read_text()
        assert [name for name in names if f'\\"{name}' not in code] == []


def test_the_gallery_has_every_artefact_in_the_order_of_the_thesis(run):
    read(run)
    gallery = (run.settings.figures / page.GALLERY).read_text()
    titles = re.findall(r"^### (?:\w+ \w+\.\d+\. )?(.+)$", gallery, re.MULTILINE)
    assert titles == [artefact["title"] for artefact in ARTEFACTS]
    links = re.findall(r"\]\(([^)]+)\)", gallery)
    assert len(links) > 30 and all((run.settings.figures / link).is_file() for link in links)
    assert "embedded world" in gallery and all(
        artefact["caption"] in gallery for artefact in ARTEFACTS
    )


def test_links_are_relative_and_exist_and_no_folder_of_the_machine_is_named(run):
    shown = read(run)
    links = shown.values("a", "href") + shown.values("img", "src")
    assert any("08_results.html" in link for link in links)
    for link in links:
        assert (
            link[1:] in shown.ids
            if link.startswith("#")
            else (run.settings.figures / unquote(link)).is_file()
        ), link
    for path in (run.page, run.executed.with_suffix(".html")):
        text = path.read_text()
        assert "script" not in {tag for tag, _ in Reader(text).elements}
        # the name of MathML's vocabulary is no address that is loaded
        text = text.replace("http://www.w3.org/1998/Math/MathML", "")
        assert not re.search(r"https?:|url\(|@import|file:|\$\$", text)
        assert "<mi></mi>" not in text  # a formula whose letters stand outside of their tags
        assert str(ROOT) not in text and str(run.settings.figures.parent) not in text


def test_the_page_in_git_does_not_depend_on_the_machine_or_day(run):
    text = read(run).text
    assert (
        "29 February 2024" in text and platform.python_version() in text and "tensorflow 2." in text
    )
    in_git = replace(run.settings, figures=ROOT / "figures")  # read, not written
    before = page.build(in_git)
    assert (
        platform.python_version() not in before.replace("tensorflow", "")
        and "29 February" not in before
    )
    os.utime(run.executed, (1900000000,) * 2)
    assert page.build(in_git) == before and "2030" in page.build(run.settings)
    shown = Reader(before)
    links = shown.values("a", "href") + shown.values("img", "src")
    files = [link for link in links if not re.match("#|https:", link)]
    missing = [link for link in files if not (ROOT / "figures" / link.split("#")[0]).is_file()]
    assert len(files) > 80 and missing == []
    assert {link[1:] for link in links if link.startswith("#")} <= shown.ids
    # the numbers of the answer on real frames are seen before anything is unfolded
    places = [0]
    for text in (
        'id="real-frames"',
        "<table>",
        'id="answer"',
        'id="this-run"',
        '<details id="demonstration">',
        'id="findings"',
        'id="figure-comparison"',
        "</details>",
        'id="chapter-4-on-real-frames"',
        'id="real-table-comparison"',
        'id="chapter-4"',
        'id="table-comparison"',
    ):
        places.append(before.index(text, places[-1] if text == "</details>" else 0))
    assert places == sorted(places)
    # the answer on real frames, with its number, is the first text of the page
    ratio = re.search(r"(\d\.\d\d) times", (ROOT / "docs" / "answer.md").read_text())[1]
    assert ratio in before.partition("</h1>")[2].partition("</p>")[0]
    assert str(Path("my build", "embedded-demo", "notebooks")) in shown.text


def test_markup_in_names_and_texts_is_escaped(run, tmp_path):
    attack = '<img src=x onerror="alert(1)">\'&'
    kitti = tmp_path / f"kitti{attack}"
    kitti.mkdir()
    settings = replace(run.settings, kitti=kitti, kitti_is_embedded=False, run=f"run{attack}")
    (settings.figures / "table_4_2.csv").write_text(
        f'sequence,"{attack.replace(chr(34), chr(34) * 2)}"\n<script>,1\n'
    )
    (settings.figures / "findings.md").write_text(
        f"# {attack}\n\n[a](javascript:alert(1)) <script>alert(1)</script>"
    )
    run.executed.rename(run.executed.with_name(f"09{attack}.ipynb".replace("/", "")))
    page.update(settings, settings.figures)
    text = run.page.read_text()
    shown = Reader(text)
    assert not {"script", "onerror"} & {
        name for tag, attributes in shown.elements for name in (tag, *attributes)
    }
    assert "javascript" not in "".join(shown.values("a", "href")) and "x" not in shown.values(
        "img", "src"
    )
    # the run, the folder, the notebook, the table's header, the text
    assert shown.text.count(attack) >= 5
    for link in shown.values("a", "href"):
        assert link.startswith("#") or (settings.figures / unquote(link)).is_file(), link


def test_a_table_shows_the_numbers_of_its_file(run):
    read(run)
    table = re.search(r'<figure id="table_4_2".*?</figure>', run.page.read_text(), re.DOTALL)[0]
    rows = [re.findall(r"<t[dh]>(.*?)</t[dh]>", row) for row in table.split("<tr")[2:]]
    assert rows == [
        ["00", "0.5", "-3.25", "1"],
        ["01", "12.0", "4.50", ""],
        ["sequences improved", "", "1", "0"],
    ]


def test_counts_are_whole_and_the_digits_of_a_column_are_equal():
    table = pd.DataFrame(
        {
            "measure": ["images", "IoU", "pixels (%)", "improved"],
            "here": [20.0, 0.31, 92.0, 9.0],
            "package": [99.0, 0.5, 91.7, 6.7],
            "ratio": [12.0, 1.0, 0.9971, 5.0],
        }
    )
    cells = re.findall(
        "<td>(.*?)</td>", tables.html(table.astype({n: "Float64" for n in table.columns[1:]}))
    )
    assert [cells[i : i + 4] for i in range(0, 16, 4)] == [
        ["images", "20", "99", "12"],
        ["IoU", "0.31", "0.5", "1.0000"],
        ["pixels (%)", "92.00", "91.7", "0.9971"],
        ["improved", "9", "6.7", "5"],
    ]


def test_an_update_renders_changed_notebooks_only(run):
    html = run.executed.with_suffix(".html")
    page.update(run.settings, run.settings.figures)
    first = html.stat().st_mtime_ns
    (run.settings.figures / "figure_4_06.svg").unlink()
    (run.settings.figures / "table_4_1.csv").write_text("sequence,frames\n00,77\n")
    page.update(run.settings, run.settings.figures)
    assert "40 of 41" in run.page.read_text() and ">77<" in run.page.read_text()
    assert html.stat().st_mtime_ns == first
    run.executed.write_text(run.executed.read_text().replace("a number: 42", "a number: 43"))
    os.utime(run.executed, ns=(first + 10**9,) * 2)
    page.update(run.settings, run.settings.figures)
    assert "a number: 43" in html.read_text()


def test_numbers_of_the_run_and_of_the_thesis(run):
    (run.settings.build / "model").mkdir()
    (run.settings.build / "model" / "history.csv").write_text(
        "epoch,loss,f1-score,iou_score,val_loss,val_f1-score,val_iou_score\n"
        "1,0.9,0.1,0.1,0.8,0.21,0.2\n2,0.7,0.3,0.2,0.9,0.2,0.1\n"
    )
    (run.settings.figures / "timings").mkdir()
    (run.settings.figures / "timings" / "seconds.csv").write_text(
        "sequence,method,dilation_width,seconds\n"
        "00,baseline,,4\n01,baseline,,6\n00,masked,1,4\n01,masked,1,4\n00,masked,2,11\n"
    )
    (run.settings.figures / "table_4_1.csv").write_text("sequence,mean keypoints\n00,500\n01,300\n")
    text = read(run).text
    assert (
        "Here: 4.0 to 6.7 times fewer" in text and "gives 2.0 to 4.1 times fewer than 2000" in text
    )
    assert (
        "Here: 2 epochs, the best was 1; last epoch: train loss 0.70, F1 0.30, IoU 0.20; validation loss 0.90, F1 0.20"
        in text
    )
    assert "5 to 10 % of the time saved." in text and "Here: -10 to 20 % of the time saved" in text
    assert "15,337,571 parameters" in text


def test_the_count_of_improved_sequences_is_whole():
    rows = {"sequence": ["mean", tables.IMPROVED], "a": [-1.25, 9.0], "b": [2.5, 9.64]}
    text = tables.html(pd.DataFrame(rows).convert_dtypes())
    assert re.findall("<td>(.*?)</td>", text) == [
        "mean",
        "-1.25",
        "2.50",
        tables.IMPROVED,
        "9",
        "9.64",
    ]
