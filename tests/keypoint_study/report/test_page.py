"""The page of a run, on a figures folder of made-up files."""

import ast
import json
import os
import re
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import unquote

import nbformat
import pandas as pd
import pytest
from bs4 import BeautifulSoup

from keypoint_study.report import html, style
from thesis import captions, page
from thesis.settings import ROOT, read_settings

SVG = '<svg height="100pt" width="200pt" xmlns="http://www.w3.org/2000/svg"><path d="M0 0"/></svg>'
TABLE = pd.DataFrame(
    {
        "sequence": ["00", "01", "sequences improved"],
        "RMSE (m)": [0.5, 12, None],
        "change (%)": [-3.25, 4.5, 1],
        "change (%), thesis": [1, None, 0],
    }
)
ARTEFACTS = [
    *(artefact for chapter in captions.CHAPTERS.values() for artefact in chapter),
    *captions.ADDED,
]


class Reader:
    """The text of a page and its elements as (tag, attributes)."""

    def __init__(self, text):
        soup = BeautifulSoup(text, "html.parser")
        self.elements = [(element.name, element.attrs) for element in soup.find_all(True)]
        self.text = " ".join(soup.get_text().split())
        self.ids = {element["id"] for element in soup.find_all(id=True)}

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
    settings = replace(settings, figures=settings.published)
    settings.figures.mkdir()
    for artefact in ARTEFACTS:
        for ending in html.ENDINGS[artefact["kind"]][: 1 if artefact["kind"] == "figure" else None]:
            text = {".svg": SVG}.get(ending, "What it shows")
            (settings.figures / f"{artefact['name']}{ending}").write_text(text)
        if artefact["kind"] == "table":
            style.save_table(TABLE, settings.figures, artefact["name"], "a note")
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


def test_missing_artefacts_are_listed_unless_their_data_were_not_given(run):
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
    assert shown.values("a", "href").count("#figure_3_05") == 2
    on_real_frames = replace(run.settings, kitti_is_embedded=False)
    text = page.build(on_real_frames)
    missing = re.search(r'<p class="missing">Missing:(.*?)</p>', text, re.DOTALL)[1]
    assert (
        "#figure_4_06" in missing and "figure_3_05" not in missing and "domain_gap" not in missing
    )
    assert text.count("CITYSCAPES=/path") == text.count("KITTI_SEMANTIC=/path") == 1


def saved_names(notebook):
    """The names that calls of save_figure and save_table in a notebook's cells have as strings."""
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text())["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    code = "\n".join(line for source in sources for line in source.split("\n") if line[:1] != "%")
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("_figure", "_table")):
            strings = [each.value for each in node.args if isinstance(each, ast.Constant)]
            yield from (text for text in strings if re.fullmatch(r"[a-z]\w+", str(text)))


def test_each_artefact_has_a_caption_a_notebook_and_files_in_git():
    listed, faults = {artefact["name"] for artefact in ARTEFACTS}, []
    for notebook, names in captions.MADE_BY.items():
        code = (ROOT / "notebooks" / f"{notebook}.ipynb").read_text()
        faults += [f"{notebook}.ipynb: saves no {name}" for name in names if name not in code]
        unknown = set(saved_names(notebook)) - set(names)
        faults += [f'captions.json: add "{name}" to made_by of {notebook}' for name in unknown]
    written = {name for names in captions.MADE_BY.values() for name in names}
    faults += [f'captions.json: add an entry of "{name}"' for name in written - listed]
    faults += [f'captions.json: add "{name}" to made_by' for name in listed - written]
    missing = [name for name in listed if not list((ROOT / "figures").glob(f"{name}.*"))]
    faults += [f"figures/{name}: is not there; run make figures" for name in missing]
    assert faults == []


def test_the_gallery_has_every_artefact_in_the_order_of_the_thesis(run):
    read(run)
    gallery = (run.settings.figures / page.GALLERY).read_text()
    titles = re.findall(r"^### (?:\w+ \w+\.\d+\. )?(.+)$", gallery, re.MULTILINE)
    assert titles == [artefact["title"] for artefact in ARTEFACTS]
    links = re.findall(r"\]\(([^)]+)\)", gallery)
    assert len(links) > 30 and all((run.settings.figures / link).is_file() for link in links)
    assert gallery.startswith(f"# Figures and tables, run {run.settings.run}\n")
    assert "<details>" not in gallery
    rows = pd.DataFrame({"number": range(24), "no worse": "yes"})
    style.save_table(rows, run.settings.figures, "few_keypoints", "a note")
    text = page.gallery(run.settings)
    assert text.count("<details>") == text.count("</details>") == text.count("24 rows") == 1


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


def test_markup_in_names_and_texts_is_escaped(run, tmp_path):
    attack = '<img src=x onerror="alert(1)">\'&'
    kitti = tmp_path / f"kitti{attack}"
    kitti.mkdir()
    settings = replace(run.settings, kitti=kitti, kitti_is_embedded=False, run=f"run{attack}")
    table = pd.DataFrame({"sequence": ["<script>"], attack: [1]})
    style.save_table(table, settings.figures, "table_4_2", "a note")
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


def test_the_page_in_git_is_made_from_what_is_in_git():
    """After a change of docs/answer.md, a caption or a table: `make page`."""
    figures = ROOT / "figures"  # read, not written
    in_git = replace(read_settings({}), figures=figures)
    shown = Reader((figures / "index.html").read_text())
    assert (figures / "index.html").read_text() == page.build(in_git)
    assert (figures / page.GALLERY).read_text() == page.gallery(in_git)
    assert page.gallery(in_git).startswith("# Figures and tables\n")  # two runs: real and rendered
    links = shown.values("a", "href") + shown.values("img", "src")
    files = [link for link in links if not re.match("#|https:", link)]
    missing = [link for link in files if not (ROOT / "figures" / link.split("#")[0]).is_file()]
    assert len(files) > 80 and missing == []
    assert {link[1:] for link in links if link.startswith("#")} <= shown.ids


def test_numbers_of_the_run_stand_beside_the_thesiss(run):
    files = {
        run.settings.figures / "figure_4_01.csv": "epoch,val_loss\n1,0.8\n2,0.9\n",
        run.settings.figures / "table_4_1.csv": "sequence,mean keypoints\n00,500\n01,300\n",
        run.settings.figures / "timings" / "seconds.csv": (
            "sequence,method,dilation_width,seconds\n00,baseline,,10\n00,masked,1,8\n00,masked,2,11\n"
        ),
    }
    for path, text in files.items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    numbers = page.beside_the_thesis(run.settings)
    assert (numbers["figure_4_01"]["epochs"], numbers["figure_4_01"]["best"]["epoch"]) == (2, 1)
    assert list(numbers["figure_4_07"]["keypoints"]) == [500, 300]
    assert list(numbers["figure_4_17"]["saved"]) == [20, -10]


def test_a_drawn_figure_is_copied_to_where_figures_are_read(run, tmp_path):
    page.update(run.settings, tmp_path / "read")
    assert (tmp_path / "read" / "figure_4_06.svg").read_text() == SVG
    assert (tmp_path / "read" / "index.html").is_file() and not run.page.exists()
