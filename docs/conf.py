"""How Sphinx makes the book from the folder that `thesis.book` arranges."""

import json
import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

from thesis import gallery

CITATION = (Path(__file__).parents[1] / "CITATION.cff").read_text(encoding="utf-8")
BOOK = ""  # where the book is hosted, once it is: README then links it

project = html_title = "Keypoint masks for visual odometry"
extensions = ["myst_nb", "sphinx.ext.autodoc"]
include_patterns = ["**.md", "notebooks/*.ipynb"]
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
html_show_copyright = html_domain_indices = False
author = "the contributors of thesis-repro"
html_last_updated_fmt = None

PICTURE = re.compile(r'(<img\b[^>]*?\bsrc="([^"]+)"[^>]*>)')
SCROLLS = re.compile(r'<div class="(?:pst-scrollable-table-container|output text_html|equation)"')

# of pages that are a table alone
titles = {each["name"]: each["title"] for each in [*gallery.OF_THESIS, *gallery.ADDED]} | {
    "equal_number": "Choices of keypoints at an equal number",
    "every_second": "Few keypoints, every second frame",
    "refined_widths": "Masks of every width, refined estimator",
    "scores": "Label maps of the thesis's network",
    "streets": "Streets",
    "training": "The thesis's network",
}
PLACES = {
    "figures/kitti_excerpts": " (real frames)",
    "figures/camvid": " (trained on CamVid)",
    "results": " (this run)",
}


def in_book(app, docname, source):
    """Complete the text of a page before it is read."""
    folder, _, name = docname.rpartition("/")
    if folder == "notebooks":
        source[0] = lesson(name, json.loads(source[0]))
    elif docname == "index":
        if not Path(app.srcdir, "results").is_dir():  # the default run's is the gallery
            source[0] = source[0].replace("/results/README\n", "")
        for key, value in re.findall(r"(?m)^(version|date-released): (.+)", CITATION):
            source[0] = source[0].replace(f"[{key}]", value)
    elif folder and not re.match(r"(<!--.*?-->\s*)?#", source[0], re.DOTALL):  # without a title
        title = titles.get(name, name.replace("_", " ").capitalize()) + PLACES.get(folder, "")
        source[0] = f"---\norphan: true\n---\n# {title}\n\n{source[0]}"


def lesson(name, notebook):
    """Return a notebook with its name in the lab and alternative texts, as JSON."""
    first = notebook["cells"][0]
    first["source"] = "".join(first["source"]) + f"\n\n**In the lab:** `make lab`, `{name}.ipynb`."
    if not any(cell.get("outputs") for cell in notebook["cells"]):
        first["source"] += "\n\n**Not run with the data of this book**, so without results."
    for cell in notebook["cells"]:
        for output in cell.get("outputs", ()):
            written = output.get("data", {}).get("text/markdown")
            if written:  # what a notebook shows stands beside the figures, the page does not
                output["data"]["text/markdown"] = re.sub(
                    r"\]\(([\w-]+\.(?:csv|md|svg|webp))\)", r"](/figures/\1)", "".join(written)
                )
        keys = (cell["id"], *re.findall(r'"(\w+)"', "".join(cell["source"])))
        cell["metadata"]["seen"] = [gallery.SEEN[key] for key in keys if key in gallery.SEEN]
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


def reach_by_all(app, pagename, templatename, context, doctree):
    """Let pictures link their files, the keyboard reach what scrolls, and lists have names."""
    made = context.get("generate_toctree_html")
    if made is not None:
        context["generate_toctree_html"] = lambda *given, **named: str(
            made(*given, **named)
        ).replace("<summary>", '<summary aria-label="pages below this one">')
    if "body" not in context:
        return
    body = SCROLLS.sub(r'\g<0> tabindex="0"', context["body"])
    body = re.sub(r"<th(?: class=\"head\")?>(?:<p></p>)?</th>", "<td></td>", body)  # heads nothing
    parts = re.split(r"(<a\b.*?</a>)", body, flags=re.DOTALL)  # what is linked stays
    parts[::2] = [PICTURE.sub(r'<a href="\2">\1</a>', part) for part in parts[::2]]
    context["body"] = "".join(parts)


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
    app.connect("html-page-context", reach_by_all, priority=900)  # after those of the theme
    app.add_html_math_renderer("mathml", (line_of_mathml, None), (block_of_mathml, None))
