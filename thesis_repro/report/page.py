"""One page with every table and figure of a run: index.html beside them, to be opened from disk.

`python -m thesis_repro.report.page` turns the executed notebooks into HTML where they have changed, and writes the page
where anything it shows has. Neither needs a network, a server or scripts to be read. This module says what is
shown; template.html says how.
"""

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import mistune
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from thesis_repro import longrun, stages
from thesis_repro.files import write_text
from thesis_repro.report import captions, gap, style
from thesis_repro.settings import ROOT, read_settings

PAGE = "index.html"
EVIDENCE = "kitti_excerpts/README.md"  # beside the default run's page
HERE = Path(__file__).parent
THESIS = [name for artefacts in captions.CHAPTERS.values() for name in artefacts]
ENDINGS = {"figure": (".svg", ".webp"), "table": (".csv", ".md"), "text": (".md",)}  # the first there is shown
CSS_DPI = 96  # a browser's pixels an inch
PACKAGES = ("tensorflow", "keras", "opencv-python-headless", "numpy")  # what numbers depend on most
TEMPLATES = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                        lstrip_blocks=True)
NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")
RANGE = re.compile(rf"{NUMBER.pattern}( to {NUMBER.pattern})?")
WHOLE = re.compile(r"[+-]?\d+(\.0+)?")


def update(settings):
    """Write the notebooks' HTML and the page where what they show has changed; True if the page was written.

    What killed runs left half written in the run's folders is deleted. Raises InputError where another run is at work.
    """
    with longrun.claimed(settings.build / "notebooks"):
        longrun.sweep(settings.build)
        if settings.figures.is_dir():
            longrun.sweep(settings.figures)
        page, executed = settings.figures / PAGE, _executed(settings)
        write_notebooks(executed, page)
        html = build(settings)
        if page.is_file() and page.read_bytes() == html.encode():
            return False
        write_text(page, html)
    return True


def _made_from(path):
    """A comment at the end of a notebook's page that says what the notebook and this module hold.

    Dates would not do: the clock of a machine can jump.
    """
    digest = hashlib.sha256()
    for part in sorted([path, *HERE.iterdir()]):
        if part.is_file():
            digest.update(f"{part.name} {stages.content(part)}\n".encode())
    return f"<!-- made from {digest.hexdigest()[:12]} -->\n"


def _ends_with(path, text):
    return path.is_file() and path.read_bytes().endswith(text.encode())


def _executed(settings):
    # in the order of the notebooks; a half-written one has a name that starts with a dot
    return sorted((settings.build / "notebooks").glob("[!.]*.ipynb"))


def write_notebooks(paths, page):
    """Write each executed notebook as HTML beside it, with a link back to the page, where that is not done yet."""
    made_from = {path: _made_from(path) for path in paths}
    paths = [path for path in paths if not _ends_with(path.with_suffix(".html"), made_from[path])]
    if not paths:
        return
    from nbconvert import HTMLExporter  # slow to import, and seldom needed

    # nbconvert's whole pages load scripts from the network; the bare content needs none
    exporter = HTMLExporter(template_name="basic", embed_images=True, exclude_input_prompt=True,
                            exclude_output_prompt=True, exclude_anchor_links=True)
    for path in paths:
        content, resources = exporter.from_filename(str(path))
        write_text(path.with_suffix(".html"), TEMPLATES.get_template("notebook.html").render(
            title=path.stem, style="\n".join(resources["inlining"]["css"]), content=content,
            page=os.path.relpath(page, path.parent)) + made_from[path])


def build(settings):
    """The page of a run as HTML, from the files in its folders."""
    makers, here = _makers(), _here(settings)
    chapters = [{"id": re.sub(r"\W+", "-", chapter.split(":")[0].lower()), "title": chapter, "artefacts": [
        _artefact(settings, name.split("_")[0], name, title, caption, makers) | {"here": here.get(name)}
        for name, (title, caption) in artefacts.items()]} for chapter, artefacts in captions.CHAPTERS.items()]
    shown = sum(one["there"] for chapter in chapters for one in chapter["artefacts"])
    chapters.append({"id": "added", "title": "Beyond the thesis", "artefacts": [
        _artefact(settings, kind, name, title, caption, makers)
        for (kind, name), (title, caption) in captions.ADDED.items()]})
    notebooks = {}
    if not settings.figures_in_git:  # in a clone there is no build folder to link to
        notebooks = {path.stem: os.path.relpath(path.with_suffix(".html"), settings.figures)
                     for path in _executed(settings)}
    words = settings.figures / "findings.md"
    return TEMPLATES.get_template("template.html").render(
        short=_markdown(words.read_text(encoding="utf-8").split("\n\n")[0]) if words.is_file() else None,
        evidence=EVIDENCE if (settings.figures / EVIDENCE).is_file() else None,
        title=f"Tables and figures, {settings.run}", style="", settings=settings, facts=_facts(settings),
        chapters=chapters, shown=shown, of=len(THESIS), notebooks=notebooks,
        missing=[one for chapter in chapters for one in chapter["artefacts"] if not one["there"]
                 and not one["left_out"]],
        left_out=[one for chapter in chapters for one in chapter["artefacts"] if one["left_out"]], card=captions.CARD,
        folder=os.path.relpath(settings.build / "notebooks", settings.figures))


def _facts(settings):
    sizes = settings.sizes
    # A page in git is that of its commit, made anywhere on any day.
    made = {} if settings.figures_in_git else {
        "results of": _when(settings),
        "code": _commit(),
        "Python": f"{platform.python_version()} on {platform.system()} {platform.machine()}, {settings.jobs} processes",
    }
    frames = "all frames" if sizes.frames is None else f"at most {sizes.frames} frames"
    images = "all images" if sizes.training_images is None else f"at most {sizes.training_images} images"
    network = (f"network {sizes.image_size}x{sizes.image_size} with {sizes.base_filters} filters in the first block, "
               f"up to {sizes.epochs} epochs on {images}; ")
    sequences = _read(settings.figures / "table_4_1.csv")
    return {
        "odometry data": "embedded world" if settings.kitti_is_embedded else f"KITTI folder “{settings.kitti.name}”",
        "sequences": ", ".join(f"{row['sequence']} ({row['frames']} frames)"
                               for row in sequences.to_dict("records") if row.get("frames")),
        "label maps": f"by the model in the package; its card is {captions.CARD}" if settings.shipped else None,
        "training data": None if settings.shipped else "embedded world" if settings.cityscapes_is_embedded
                         else f"Cityscapes folder “{settings.cityscapes.name}”",
        "KITTI's street scenes": settings.kitti_semantic and f"folder “{settings.kitti_semantic.name}”",
        "quality of label maps": (said := gap.line(settings.build)) and said.removeprefix("label maps "),
        "profile": f"{settings.profile}: {'' if settings.shipped else network}{frames} of each sequence, "
                   f"{len(sizes.widths)} dilation widths, {sizes.repetitions} repetitions",
        "seeds": f"{settings.seed} throughout; repetition 0 keeps the order of the correspondences, repetition n "
                 "shuffles it with seed n",
        **made,
        "packages": _packages(),
    }


def _packages():
    return (", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
            + "; environment.txt has them all")


def _when(settings):
    """The day on which the last cell of the notebooks ran."""
    cells = [cell for path in _executed(settings) for cell in _cells(path)]
    times = [time for cell in cells if (time := cell["metadata"].get("execution", {}).get("iopub.execute_input"))]
    return f"{datetime.fromisoformat(max(times)).astimezone(UTC):%d %B %Y}" if times else None


def _commit():
    def git(*arguments):
        command = ["git", "--git-dir", ROOT / ".git", "--work-tree", ROOT, *arguments]  # of no checkout around this one
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.strip()

    try:
        commit, changed = git("rev-parse", "--short=12", "HEAD"), git("status", "--porcelain", "--", ".", ":!figures")
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"commit {commit}{' with uncommitted changes' if changed else ''}"


def _artefact(settings, kind, name, title, caption, makers):
    """What the template needs to show a table, a figure or a text, or to say that it is missing."""
    number, shown = None, _shown(settings.figures, kind, name)
    if name in THESIS:  # figure_4_07 is Figure 4.7, figure_a_01 is Figure A.1
        _, chapter, count = name.split("_")
        number = f"{kind.capitalize()} {chapter.upper()}.{int(count)}"
    return {
        "kind": kind, "id": name if number or kind == "text" else f"{kind}-{name}", "number": number,
        "title": f"{number}. {title}" if number else title, "caption": caption,
        "makers": makers.get(name, []), "reported": _reported(settings, name), "here": None,
        "label_maps": gap.line(settings.build) if name in captions.ON_LABEL_MAPS else None,
        **shown, "left_out": settings.shipped and name in captions.OF_TRAINING and not shown["there"],
    }


def _shown(folder, kind, name):
    """What there is of a table, a figure or a text in a folder."""
    files = [path for ending in ENDINGS[kind] if (path := folder / f"{name}{ending}").is_file()]
    shown = ENDINGS[kind] if kind == "figure" else ENDINGS[kind][:1]
    path = next((path for path in files if path.suffix in shown), None)
    return {
        "there": path is not None, "files": [path.name for path in files], "left_out": False,
        "size": _size(path) if path and kind == "figure" else None,
        "table": _table(path) if path and kind == "table" else None,
        "html": _markdown(path.read_text(encoding="utf-8")) if path and kind == "text" else None,
    }


def build_study(folder, artefacts, facts, embedded):
    """The page of a study as HTML, from the files in its folder.

    artefacts: {(kind, name): (title, caption)}, as in captions. facts: what was run, {name: text}.
    embedded: whether the frames are those of the embedded world.
    """
    shown = [{"kind": kind, "id": name if kind == "text" else f"{kind}-{name}", "number": None, "title": title,
              "caption": caption, "makers": [], "reported": None, "here": None, "label_maps": None,
              **_shown(folder, kind, name)}
             for (kind, name), (title, caption) in artefacts.items()]
    return TEMPLATES.get_template("study.html").render(
        title="A study of masks", style="", artefacts=shown, embedded=embedded, notebooks={}, facts=facts | {
            "code": _commit(), "Python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
            "packages": _packages()})


def _makers():
    """The notebooks in whose code a table or figure is named, {name: [notebooks]}."""
    found = {}
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        code = "\n".join("".join(cell["source"]) for cell in _cells(path) if cell["cell_type"] == "code")
        for name in sorted(set(re.findall(r'"(\w+)(?:\.\w+)?"', code))):
            found.setdefault(name, []).append(path.stem)
    return found


def _reported(settings, name):
    """What the thesis says in words about a figure, and from which data."""
    if name not in captions.REPORTS or not name.startswith("figure"):
        return None
    source, text = captions.REPORTS[name]
    return {"text": text,
            "data": {"runs": ", complete KITTI sequences", "training": ", Cityscapes", "model": ""}[source],
            "embedded": {"runs": settings.kitti_is_embedded, "training": settings.cityscapes_is_embedded}.get(source)}


def _here(settings):
    """This run's numbers of the kind that the thesis reports in words, {name: text}, from the files that there are."""
    found = {}
    history, runs = (_numbers(settings.build / name) for name in ("model/history.csv", "runs.csv"))
    seconds = _numbers(settings.figures / "timings" / "seconds.csv")
    if len(history):
        best = history.loc[history["val_loss"].idxmin()]
        scores = (f"{split} loss {best[f'{prefix}loss']:.2f}, F1 {best[f'{prefix}f1-score']:.2f}, "
                  f"IoU {best[f'{prefix}iou_score']:.2f}" for split, prefix in (("train", ""), ("validation", "val_")))
        found["figure_4_01"] = f"{len(history)} epochs, the best was {best['epoch']:.0f}; {'; '.join(scores)}."
    chosen = _numbers(settings.figures / "table_4_1.csv")
    if len(runs) and "mean keypoints" in chosen:
        every = runs[runs["method"] == "baseline"].groupby("sequence")["mean_keypoints"].mean()
        kept = chosen.set_index("sequence")["mean keypoints"]
        factors = (every / kept[kept > 0]).dropna()
        found["figure_4_07"] = (f"{factors.min():.1f} to {factors.max():.1f} times fewer than without masks, with the "
                                "widths of Table 4.1.")
    if len(seconds):
        masked = seconds[seconds["method"] == "masked"].groupby("dilation_width")["seconds"].sum()
        saved = 100 * (1 - masked / seconds.loc[seconds["method"] == "baseline", "seconds"].sum())
        found["figure_4_17"] = f"{saved.min():.0f} to {saved.max():.0f} %, by width.".replace("-", "−")
    return found


# Files


def _cells(path):
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def _numbers(path):
    """A CSV file as a table; an empty one where there is no file."""
    return pd.read_csv(path, dtype={"sequence": str}) if path.is_file() else pd.DataFrame()


def _read(path):
    """A CSV file as it is written, every cell a text; an empty table where there is no file."""
    return pd.read_csv(path, dtype=str, keep_default_na=False) if path.is_file() else pd.DataFrame()


def _table(path):
    """A CSV file for reading: columns as (name, whether numbers), and rows of texts.

    Whole numbers lose the point that missing values give them, and changes in percent have equally many digits.
    """
    table = _read(path)
    number, whole = (table.map(lambda cell, kind=kind: bool(kind.fullmatch(cell))) for kind in (NUMBER, WHOLE))
    counts = (number.sum(axis=1) > 1) & (number == whole).all(axis=1)  # such as a row that counts sequences
    columns = []
    for name, cells in table.items():
        filled = cells[cells != ""]
        columns.append((name, name != "sequence" and len(filled) > 0 and filled.str.fullmatch(RANGE).all()))
        if not columns[-1][1]:
            continue
        digits = cells.where(number[name], "").str.partition(".")[2].str.len().max()
        short = number[name] & (counts | whole.loc[filled.index, name].all())
        table[name] = [cell.split(".")[0] if cut else f"{float(cell):.{digits}f}" if "%" in name and is_number else cell
                       for cell, cut, is_number in zip(cells, short, number[name])]
        table[name] = table[name].str.replace("-", "−")
    return {"columns": columns, "rows": table.to_numpy().tolist()}


def _size(path):
    """Width and height in a browser's pixels, so that the page keeps its place while it loads."""
    if path.suffix == ".webp":
        with Image.open(path) as image:
            return [round(side * CSS_DPI / style.STYLE["savefig.dpi"]) for side in image.size]
    with open(path, encoding="utf-8") as file:
        head = file.read(2000)
    sides = [re.search(rf'<svg[^>]*?\s{side}="([\d.]+)pt"', head) for side in ("width", "height")]
    return [round(float(side[1]) * 4 / 3) for side in sides] if all(sides) else None  # silent


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text, level, **attributes):
        return super().heading(text, max(4, level + 1), **attributes)  # below those of the page


def _markdown(text):
    """Markdown as HTML; HTML in it is shown as text."""
    return mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])(text)


def main():
    try:
        update(read_settings())
    except Exception as error:
        return longrun.report_error(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
