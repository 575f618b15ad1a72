"""One page with every table and figure of a run: index.html beside them, to be opened from disk.

`python -m thesis_repro.report.page` turns the executed notebooks into HTML where they are newer, and writes the page when
anything it shows is newer. Neither needs a network, a server or scripts to be read.
"""

import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from datetime import datetime, timezone
from functools import lru_cache
from html import escape
from pathlib import Path

from thesis_repro import InputError
from thesis_repro.report import captions, html_parts
from thesis_repro.files import write_text
from thesis_repro.settings import ROOT, read_settings

PAGE = "index.html"
THESIS = [name for artefacts in captions.CHAPTERS.values() for name in artefacts]
CODE = ("thesis_repro", "notebooks", "environment.txt", "pyproject.toml", "Makefile")
ENDINGS = {"figure": (".svg", ".png"), "table": (".csv", ".md"), "text": (".md",)}  # the first is the one shown
WIDE = 9  # columns; a table with more is printed on a page laid on its side


def update(settings):
    """Write the notebooks' HTML and the page where they are older than what they show; True if the page was."""
    settings.figures.mkdir(parents=True, exist_ok=True)
    page, executed = settings.figures / PAGE, _executed(settings)
    write_notebooks([path for path in executed if _newer([path, *_own_files()], path.with_suffix(".html"))], page)
    if not _newer([*executed, *_own_files(), settings.figures, *settings.figures.glob("*.*")], page):
        return False
    write_text(page, build(settings))
    os.utime(page)  # renaming made the folder newer than the file
    return True


def _own_files():
    names = ("page.py", "page.css", "html_parts.py", "captions.py")
    return [Path(__file__).parent / name for name in names]


def _newer(paths, made):
    return not made.is_file() or max(path.stat().st_mtime_ns for path in paths) > made.stat().st_mtime_ns


def _executed(settings):
    # in the order of the notebooks; a half-written one has a name that starts with a dot
    return sorted(path for path in (settings.build / "notebooks").glob("[!.]*.ipynb"))


# The notebooks


def write_notebooks(paths, page):
    """Write each executed notebook as HTML beside it, with a link back to the page."""
    if not paths:
        return
    from nbconvert import HTMLExporter  # slow to import, and seldom needed

    # nbconvert's whole pages load scripts from the network; the bare content needs none
    exporter = HTMLExporter(template_name="basic", embed_images=True, exclude_input_prompt=True,
                            exclude_output_prompt=True, exclude_anchor_links=True)
    for path in paths:
        content, resources = exporter.from_filename(str(path))
        back = f'<p class="small"><a href="{html_parts.link(page, path.parent)}">all tables and figures</a></p>'
        style = html_parts.STYLE + "\n".join(resources["inlining"]["css"])
        body = f'{back}\n<main class="notebook">{content}</main>'
        write_text(path.with_suffix(".html"), html_parts.document(path.stem, style, body))


# The page


def build(settings):
    """The page of a run as HTML, from the files in its folders."""
    shown = [name for name in THESIS if _path(settings, _kind(name), name).is_file()]
    parts = ["<h1>Tables and figures</h1>",
             f"<p>Run {escape(settings.run)}: {len(shown)} of {len(THESIS)} tables and figures of the thesis.</p>",
             _embedded(settings), _missing(settings), _what_was_run(settings), HOW_TO_READ, _contents(settings)]
    here = _here(settings)
    for chapter, artefacts in captions.CHAPTERS.items():
        parts.append(f'<h2 id="{_anchor(chapter)}">{escape(chapter)}</h2>')
        parts += [_artefact(settings, _kind(name), name, f"{_number(name)}. {title}", caption, here.get(name))
                  for name, (title, caption) in artefacts.items()]
    parts.append('<h2 id="added">Beyond the thesis</h2>')
    parts += [_artefact(settings, kind, name, title, caption)
              for (kind, name), (title, caption) in captions.ADDED.items()]
    parts.append(_notebooks(settings))
    body = "<main>\n" + "\n".join(filter(None, parts)) + "\n</main>"
    return html_parts.document(f"Tables and figures, {settings.run}", html_parts.STYLE, body)


HOW_TO_READ = """<h2 id="how-to-read">How to read it</h2>
<ul>
<li>Numbers marked as the thesis's come from the complete KITTI sequences and from Cityscapes. They can be set beside
those of this run only where it used the same data at the same length.</li>
<li>The odometry is chaotic: harmless changes, such as the order in which correspondences reach RANSAC, move the error
of a whole sequence. A difference smaller than the spread of the repetitions means nothing.</li>
<li>The thesis chooses each sequence's dilation width by the error on that same sequence. A best of many looks good even
where masks do nothing; <a href="#table-widths">a fair choice</a> is below.</li>
<li>RMSE and MAE are distances in metres without alignment, and grow with a sequence's length. Changes are in percent
from all keypoints, negative where the error is smaller (Equation 4.1).</li>
<li>Whether it is the segmentation that helps, the <a href="#figure-controls">controls</a> tell;
<a href="#findings">what the runs show</a> says so in words.</li>
</ul>"""


def _embedded(settings):
    world = "the <strong>embedded world</strong>, small rendered street scenes"
    limit = "show that the way from data to results works, and cannot be set against the thesis's numbers."
    if settings.kitti_is_embedded and settings.cityscapes_is_embedded:
        text = f"All images and numbers here come from {world}. They {limit}"
    elif settings.kitti_is_embedded:
        text = (f"The odometry's frames and numbers here come from {world}. They {limit} The network is trained on the "
                "user's data.")
    elif settings.cityscapes_is_embedded:
        text = (f"Training, and what is drawn from the training data, comes from {world}; those images and numbers "
                f"{limit} The odometry's frames and numbers are the user's; the label maps come from the model in the "
                "package.")
    else:
        return ""
    return f'<p class="note">{text}</p>'


def _missing(settings):
    names = [(_kind(name), name, _number(name)) for name in THESIS]
    names += [(kind, name, title) for (kind, name), (title, _) in captions.ADDED.items()]
    missing = [f'<a href="#{_id(kind, name)}">{escape(number)}</a>' for kind, name, number in names
               if not _path(settings, kind, name).is_file()]
    return f'<p class="missing">Missing: {", ".join(missing)}.</p>' if missing else ""


def _what_was_run(settings):
    sizes, executed = settings.sizes, _executed(settings)
    frames = "all frames" if sizes.frames is None else f"at most {sizes.frames} frames"
    images = "all images" if sizes.training_images is None else f"at most {sizes.training_images} images"
    rows = {
        "odometry data": "embedded world" if settings.kitti_is_embedded
                         else f"KITTI folder “{settings.kitti.name}”",
        "sequences": ", ".join(f"{row['sequence']} ({row['frames']} frames)"
                               for row in _rows(settings.figures / "table_4_1.csv") if row.get("frames")),
        "training data": "embedded world" if settings.cityscapes_is_embedded
                         else f"Cityscapes folder “{settings.cityscapes.name}”",
        "profile": f"{settings.profile}: network {sizes.image_size}x{sizes.image_size} with {sizes.base_filters} "
                   f"filters in the first block, up to {sizes.epochs} epochs on {images}; {frames} of each sequence, "
                   f"{len(sizes.widths)} dilation widths, {sizes.repetitions} repetitions",
        "seeds": f"{settings.seed} throughout; repetition 0 keeps the order of the correspondences, repetition n "
                 "shuffles it with seed n",
        "results of": _when(settings, executed),
        "code": _commit(),
        "Python": f"{_python(executed)} on {platform.system()} {platform.machine()}, {settings.jobs} processes",
        "packages": _packages(),
    }
    lines = [f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in rows.items() if value]
    return "\n".join(['<h2 id="what-was-run">What was run</h2>', "<dl>", *lines, "</dl>"])


def _when(settings, executed):
    """When the results were made: when the notebooks' cells ran, or else the files' own time."""
    times = []
    for path in executed:
        times += [cell["metadata"]["execution"].get("iopub.execute_input", "") for cell in _read(path)["cells"]
                  if "execution" in cell.get("metadata", {})]
    times = sorted(datetime.fromisoformat(time) for time in times if time)
    if not times:
        files = [path for ending in (".svg", ".csv") for path in settings.figures.glob(f"*{ending}")]
        if not files:
            return "nothing yet"
        newest = max(path.stat().st_mtime for path in files)
        return f"{datetime.fromtimestamp(newest, timezone.utc):%d %B %Y, %H:%M} UTC"
    first, last = (time.astimezone(timezone.utc) for time in (times[0], times[-1]))
    return f"{first:%d %B %Y, %H:%M} to {last:{'%H:%M' if first.date() == last.date() else '%d %B %Y, %H:%M'}} UTC"


def _commit():
    def git(*arguments):
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    if not (ROOT / ".git").exists():  # else a checkout around this folder would answer
        return "no git checkout"
    try:
        commit, changed = git("rev-parse", "--short=12", "HEAD"), git("status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return "no git checkout"
    return f"commit {commit}" + (f" with uncommitted changes ({len(changed.splitlines())} files)" if changed else "")


def _python(executed):
    versions = {_read(path)["metadata"].get("language_info", {}).get("version") for path in executed} - {None}
    return ", ".join(sorted(versions)) or platform.python_version()


def _packages():
    """The versions of the packages that the project itself calls: the first block of environment.txt."""
    direct = (ROOT / "environment.txt").read_text(encoding="utf-8").split("# What those need")[0]
    versions = {}
    for name in re.findall(r"^([A-Za-z][\w.-]*)==", direct, re.MULTILINE):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def _contents(settings):
    def entry(kind, name, text):
        there = _path(settings, kind, name).is_file()
        return f'<li><a href="#{_id(kind, name)}">{escape(text)}</a>{"" if there else " (missing)"}</li>'

    parts = ['<nav>\n<h2 id="contents">Contents</h2>']
    for chapter, artefacts in captions.CHAPTERS.items():
        parts.append(f'<h3><a href="#{_anchor(chapter)}">{escape(chapter)}</a></h3>\n<ul>'
                     + "\n".join(entry(_kind(name), name, f"{_number(name)}. {title}")
                                 for name, (title, _) in artefacts.items()) + "</ul>")
    parts.append('<h3><a href="#added">Beyond the thesis</a></h3>\n<ul>'
                 + "\n".join(entry(kind, name, title) for (kind, name), (title, _) in captions.ADDED.items())
                 + '\n<li><a href="#notebooks">The executed notebooks</a></li></ul>\n</nav>')
    return "\n".join(parts)


def _artefact(settings, kind, name, title, caption, here=None):
    path, style = _path(settings, kind, name), kind
    if not path.is_file():
        body = f'<p class="missing">Missing. {_reason(name)}</p>'
    elif kind == "figure":
        size = html_parts.svg_size(path)
        body = (f'<a class="scroll" href="{path.name}"><img src="{path.name}" alt="{escape(title)}"'
                + (' width="{}" height="{}"'.format(*size) if size else "") + "></a>")
    elif kind == "table":
        header, *rows = html_parts.lines(path)
        body = f'<div class="scroll" tabindex="0">{html_parts.table(header, rows)}</div>'
        style = "table wide" if len(header) > WIDE else kind
    else:
        body = html_parts.markdown(path.read_text(encoding="utf-8"))
    if kind == "text":
        return f'<section id="{_id(kind, name)}">\n<h3>{escape(title)}</h3>\n{body}\n</section>'
    said = f"<p><strong>{escape(title)}.</strong> {escape(caption)}</p>"
    if name in captions.REPORTS and kind == "figure":
        said += f'<p class="thesis">{_reported(settings, name)}{escape(f" Here: {here}") if here else ""}</p>'
    files = [f'<a href="{name}{ending}">{ending[1:].upper()}</a>' for ending in ENDINGS[kind]
             if (settings.figures / f"{name}{ending}").is_file()]
    if files:
        said += f'<p class="small">{" · ".join([*files, *_made_by(settings, name)])}</p>'
    return f'<figure id="{_id(kind, name)}" class="{style}">\n{body}\n<figcaption>{said}</figcaption>\n</figure>'


def _reported(settings, name):
    source, text = captions.REPORTS[name]
    data = {"runs": ", complete KITTI sequences", "training": ", Cityscapes", "model": ""}[source]
    embedded = {"runs": settings.kitti_is_embedded, "training": settings.cityscapes_is_embedded}.get(source, False)
    return escape(f"Thesis{data}: {text}" + (" Not comparable with the embedded world." if embedded else ""))


def _here(settings):
    """This run's numbers of the kind that the thesis reports in words, {name: text}, from the files that there are."""
    found = {}
    if history := _rows(settings.build / "model" / "history.csv"):
        best = min(history, key=lambda row: float(row["val_loss"]))
        scores = [f"{split} " + ", ".join(f"{text} {float(best[prefix + key]):.2f}" for key, text in
                                          (("loss", "loss"), ("f1-score", "F1"), ("iou_score", "IoU")))
                  for split, prefix in (("train", ""), ("validation", "val_"))]
        found["figure_4_01"] = f"{len(history)} epochs, the best was {int(float(best['epoch']))}; {'; '.join(scores)}."
    baseline = {}
    for row in _rows(settings.build / "runs.csv"):
        if row["variant"] == "baseline":
            baseline.setdefault(row["sequence"], []).append(float(row["mean_keypoints"]))
    factors = [sum(baseline[row["sequence"]]) / len(baseline[row["sequence"]]) / float(row["mean keypoints"])
               for row in _rows(settings.figures / "table_4_1.csv")
               if row["sequence"] in baseline and float(row.get("mean keypoints") or 0)]
    if factors:
        found["figure_4_07"] = (f"{min(factors):.1f} to {max(factors):.1f} times fewer than without masks, with the "
                                "widths of Table 4.1.")
    if seconds := _rows(settings.build / "seconds.csv"):
        totals = {}
        for row in seconds:
            run = row["variant"], row["dilation_width"]
            totals[run] = totals.get(run, 0) + float(row["seconds"])
        unmasked = sum(total for (variant, _), total in totals.items() if variant == "baseline")
        saved = [100 * (1 - total / unmasked) for (variant, _), total in totals.items() if variant == "masked"]
        if saved:
            found["figure_4_17"] = f"{min(saved):.0f} to {max(saved):.0f} %, by width.".replace("-", "−")
    return found


def _rows(path):
    header, *rows = html_parts.lines(path) or [()]
    return [dict(zip(header, row, strict=True)) for row in rows]


def _reason(name):
    makers = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb")) if _makes(path, name)]
    if not makers:
        return "No notebook makes it yet."
    return f"Notebook {escape(' and '.join(makers))} makes it; <code>make figures</code> runs it."


def _made_by(settings, name):
    return [f'<a href="{html_parts.link(path.with_suffix(".html"), settings.figures)}">notebook {escape(path.stem)}</a>'
            for path in _executed(settings) if path.with_suffix(".html").is_file() and _makes(path, name)]


def _makes(path, name):
    return any(re.search(rf'"{name}(\.\w+)?"', "".join(cell["source"]))
               for cell in _read(path)["cells"] if cell["cell_type"] == "code")


def _notebooks(settings):
    paths = [path.with_suffix(".html") for path in _executed(settings) if path.with_suffix(".html").is_file()]
    where = os.path.relpath(settings.build / "notebooks", settings.figures)
    text = (f"<p>With their results, as <code>make figures</code> leaves them in <code>{escape(where)}</code> from "
            "here. Where this page was copied without that folder, its links to them lead nowhere.</p>")
    links = "\n".join(f'<li><a href="{html_parts.link(path, settings.figures)}">{escape(path.stem)}</a></li>'
                      for path in paths)
    return ('<h2 id="notebooks">The executed notebooks</h2>\n'
            + (f"{text}\n<ul>\n{links}\n</ul>" if paths
               else "<p>None is there; <code>make figures</code> leaves them.</p>"))


# Pieces


def _kind(name):
    return name.split("_")[0]


def _number(name):
    """figure_4_07 is Figure 4.7, figure_a_01 is Figure A.1."""
    kind, chapter, number = name.split("_")
    return f"{kind.capitalize()} {chapter.upper()}.{int(number)}"


def _id(kind, name):
    return name if kind == "text" or name.startswith(kind) else f"{kind}-{name}"


def _anchor(text):
    return re.sub(r"\W+", "-", text.split(":")[0].lower())


def _path(settings, kind, name):
    return settings.figures / f"{name}{ENDINGS[kind][0]}"


def _read(path):
    return _parsed(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=None)  # every table and figure asks for the same few notebooks
def _parsed(path, written):
    return json.loads(path.read_text(encoding="utf-8"))


def main():
    try:
        settings = read_settings()
        update(settings)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
