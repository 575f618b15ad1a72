"""How Sphinx makes the book from the folder that `thesis.book` arranges."""

import json
import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

ROOT = Path(__file__).resolve().parents[1]
CAPTIONS = ROOT / "notebooks/thesis/captions.json"
PACKAGES = ("thesis_repro", "keypoint_study", "opencv_exact", "street_world")

project = html_title = "Keypoint masks for visual odometry"
extensions = ["myst_nb"]
if tags.has("reference"):  # noqa: F821 (Sphinx defines it; `make book` sets it)
    extensions.append("autoapi.extension")
autoapi_dirs = [str(ROOT / package) for package in PACKAGES]
suppress_warnings = ["autoapi.python_import_resolution"]  # of names that are set in pairs
autoapi_options = ["members", "show-inheritance", "show-module-summary"]
include_patterns = ["**.md", "notebooks/*.ipynb", "autoapi/**"]
exclude_patterns = ["docs/index.md"]  # it is index.md, too
nb_execution_mode = "off"
nb_ipywidgets_js: dict = {}  # they would come from the network; pictures stand for sliders
nb_mime_priority_overrides = [("html", "application/vnd.jupyter.widget-view+json", None)]
nb_render_markdown_format = "gfm"  # with tables
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_theme = "sphinx_book_theme"
html_theme_options = {"navbar_persistent": []}  # one field for searches, not two
html_math_renderer = "mathml"  # browsers show it without scripts, so without the network
html_static_path = html_css_files = ["book.css"]
html_show_copyright = False
author = "the contributors of thesis-repro"
html_last_updated_fmt = None

captions = json.loads(CAPTIONS.read_text(encoding="utf-8"))


def in_book(app, docname, source):
    """Complete the text of a page before it is read."""
    folder, _, name = docname.rpartition("/")
    if folder == "notebooks":
        for path in (CAPTIONS, __file__):
            app.env.note_dependency(path)
        source[0] = lesson(name, json.loads(source[0]))
    elif docname == "index" and not Path(app.srcdir, "results").is_dir():
        source[0] = source[0].replace("/results/README\n", "")  # the default run's is the gallery
    elif folder and not source[0].startswith("#"):  # a table or findings without a title
        title = name.replace("_", " ").capitalize()
        source[0] = f"---\norphan: true\n---\n# {title}\n\n{source[0]}"


def lesson(name, notebook):
    """Return a notebook with a link to the lab and alternative texts, as JSON."""
    lab = f"http://localhost:8888/lab/tree/{name}.ipynb"
    first = notebook["cells"][0]
    first["source"] = "".join(first["source"]) + f"\n\n[Open in the lab]({lab}), after `make lab`."
    for cell in notebook["cells"]:
        keys = (cell["id"], *re.findall(r'"(\w+)"', "".join(cell["source"])))
        cell["metadata"]["seen"] = [
            captions["seen"][key] for key in keys if key in captions["seen"]
        ]
    return json.dumps(notebook)


def say_what_is_seen(app, doctree):
    """Give the pictures of each cell their alternative texts."""
    for cell in doctree.findall(nodes.container):
        words = iter(cell.get("cell_metadata", {}).get("seen", []))
        for output in cell.findall(
            lambda node: getattr(node, "attributes", {}).get("nb_element") == "mime_bundle"
        ):
            pictures = list(output.findall(nodes.image))  # the same one, in several formats
            text = next(words, None) if pictures else None
            for picture in pictures if text else ():
                picture["alt"] = text


def line_of_mathml(translator, node):
    """Write an equation that stands inside a line."""
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_of_mathml(translator, node):
    """Write an equation that stands on a line of its own."""
    math = tex2mathml(node.astext(), as_block=True)
    translator.body.append(f'<div class="equation">{math}</div>')
    raise nodes.SkipNode


def setup(app):
    """Tell Sphinx about the functions above."""
    app.connect("source-read", in_book)
    app.connect("doctree-read", say_what_is_seen)
    app.add_html_math_renderer("mathml", (line_of_mathml, None), (block_of_mathml, None))
