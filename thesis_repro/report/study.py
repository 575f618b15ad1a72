"""What a study with masks of one's own leaves: tables, figures, findings in words, and one page that shows them."""

from pathlib import Path

import matplotlib.pyplot as plt

from thesis_repro import stages
from thesis_repro.files import write_text
from thesis_repro.report import captions, findings, outcome, page, style, tables
from thesis_repro.study import controls, results
from thesis_repro.study.sources import KINDS


def write(study, summary, folder):
    """Write everything that a summary of the runs of a `series.Study` shows into a folder; returns the page's path."""
    note, made = data_note(study), {}

    def keep(kind, name, content, source=""):
        file = name.replace("NAME", source)
        if kind == "figure":
            style.save_figure(content, folder, file, note)
            plt.close(content)
        elif kind == "table":
            style.save_table(content, folder, file, note)
        else:
            write_text(folder / f"{file}.md", content)
        made[kind, file] = tuple(text.replace("NAME", source) for text in captions.STUDY[kind, name])

    style.save_table(summary.round(results.DIGITS), folder, "runs", note)
    keep("text", "findings", findings.study_words(summary, note))
    keep("table", "sources", tables.table_sources(summary))
    for estimator in study.estimators:
        keep("figure", f"keypoints-{estimator}", outcome.figure_keypoints(summary, estimator))
    for source in results.sources(summary):
        own = results.of_source(summary, source)
        if study.tested:
            keep("figure", "controls-NAME", outcome.figure_controls(own), source)
            keep("table", "controls-NAME", tables.table_controls(own), source)
        if results.of_method(own, "masked")["dilation_width"].nunique() > 1:
            keep("table", "widths-NAME", tables.table_widths(own), source)
    keep("table", "errors", tables.table_errors(summary))
    write_text(folder / page.PAGE, page.build_study(folder, made, _facts(study, summary), is_embedded(study.kitti)))
    return folder / page.PAGE


def is_embedded(kitti):
    """Whether a KITTI folder is that of an embedded world, as `thesis-repro synthesize` writes it."""
    return "train_images" in (stages.record(Path(kitti).absolute().parent) or {})


def data_note(study):
    """One line for captions: where the numbers come from."""
    frames = "embedded world (rendered)" if is_embedded(study.kitti) else f"KITTI folder {study.kitti.name}"
    masks = ", ".join(f"{source.name} ({KINDS[source.kind]}{_corrected(source)})" for source in study.sources)
    return f"odometry: {frames}; masks: {masks}"


def _corrected(source):
    """What of a source's masks is not the thesis's way."""
    default = vars(type(source.settings)())
    found = [f"{name} {value}" for name, value in vars(source.settings).items() if value != default[name]]
    return f"; {', '.join(found)}" if found and source.kind == "labels" else ""


def _facts(study, summary):
    lengths = results.of_method(summary, "baseline").groupby("sequence")["frames"].first()
    of_labels = any(source.kind == "labels" for source in study.sources)
    return {
        "odometry data": "embedded world" if is_embedded(study.kitti) else f"KITTI folder “{study.kitti.name}”",
        "sequences": ", ".join(f"{name} ({count} frames)" for name, count in lengths.items()),
        **{f"masks “{source.name}”": f"{KINDS[source.kind]} in the folder “{source.folder.name}”{_corrected(source)}"
           for source in study.sources},
        "widths": ", ".join(map(str, sorted({*study.widths, *([study.tested] if of_labels and study.tested else [])}))),
        "controls": "" if not study.tested else f"beside masks of width {study.tested}" if of_labels
                    else f"beside the masks; lines and edges are {controls.LINE_WIDTH} pixels wide",
        "estimators": ", ".join(results.ESTIMATORS[estimator] for estimator in study.estimators),
        "repetitions": f"{study.repetitions} of every run; repetition 0 keeps the order of the correspondences, "
                       "repetition n shuffles it with seed n",
    }
