"""The results of a study with the user's masks: findings, figures, tables and a page.

Tables are also written as LaTeX and figures as PDF, for use in a paper.
"""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study import compare, controls, runner
from keypoint_study.jobs import ESTIMATORS
from keypoint_study.plan import RUNS, Study
from keypoint_study.report import comparison, findings, html, paths, style, worth
from keypoint_study.sources import KINDS, UNMASKED, FileMasks, Source, own_calls
from thesis_repro.data.kitti import Sequence
from thesis_repro.data.trajectories import write_kitti_poses, write_tum
from thesis_repro.errors import one_line
from thesis_repro.masks import MaskSettings
from thesis_repro.masks.folders import LabelMasks
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.loop import detect
from thesis_repro.odometry.runs import inside
from thesis_repro.running import provenance
from thesis_repro.running.files import write_text

PATHS = "paths"  # folder of the estimated paths
DRAWN = ("masked", "keypoints")  # methods of what a user brings that acts on frames
NO_DEVIATION = "Without $\\pm$: the standard deviation is 0 in these digits, or there is one run."
FIT = 4  # columns of errors across a page, in letters that can be read


@style.applied()
def write(
    study: Study,
    runs: pd.DataFrame,
    folder: Path,
    warnings: Collection[str] = (),
    worths: pd.DataFrame | None = None,
) -> Path:
    """Write the findings, figures, tables and page of a `Study` into a folder.

    Returns the page's path. warnings: lines for the top of the page. worths: of `Study.worths`.
    """
    # `thesis-repro synthesize` leaves a record beside the KITTI folder of an embedded world
    embedded = "train_images" in (provenance.record(study.kitti.resolve().parent) or {})
    data = "embedded world (rendered)" if embedded else f"KITTI folder {study.kitti.name}"
    changed = {source.name: _changed(source) for source in study.sources}
    masks = [
        f"{source.name} ({KINDS[source.kind]}{changed[source.name]})" for source in study.sources
    ]
    note = one_line(f"odometry: {data}; compared: {', '.join(masks)}")
    write_paths(study, runs, folder)
    figures = {}
    if runs["method"].isin(DRAWN).any():
        figures["sources"] = figure_sources(study, runs)
    for sequence in study.opened:
        figures[f"paths-{sequence.name}"] = figure_paths(study, runs, sequence, folder)
    # for texts and tables
    runs = runs.assign(sequence=runs["sequence"].map(one_line))
    table = compare.comparisons(runs)
    write_text(folder / "findings.md", findings.text(runs, table, note, embedded))
    figures = {"comparison": comparison.figure_comparison(table), **figures}
    if worths is not None:
        figures["worth"] = worth.figure(worths)
    for name, figure in figures.items():
        style.write_figure(figure, folder / f"{name}.pdf")
    numbers = {
        "summary": pd.concat([comparison.table_summary(table), _failed(study, runs)]),
        "comparison": comparison.table_comparison(table),
        "widths": comparison.table_widths(runs),
        "errors": comparison.table_errors(table, runs),
    }
    if worths is not None:
        numbers["worth"] = worth.table(worths)
        provenance.write_table(folder / "worth_runs.csv", worths)
    in_latex = {name: latex(rows) for name, rows in numbers.items()}
    in_latex["errors"] = latex_errors(numbers["errors"], study.repetitions)
    if len(numbers["summary"]):  # one column a source fits into a column of text
        by_source = numbers["summary"].set_index("source").T.rename_axis("source")
        in_latex["summary"] = latex(by_source.reset_index())
    for name, text in in_latex.items():
        write_text(folder / f"{name}.tex", f"% {note}\n{text}")
    numbers["runs"] = runs.round(6)  # hundreds of pages in LaTeX
    names = style.save_all(figures, numbers, folder, note)
    widths = sorted(runs["dilation_width"].dropna().astype(int).unique())
    text = html.build_study(
        folder,
        [("text", "findings"), *names],
        study=study,
        warnings=warnings,
        embedded=embedded,
        kinds=KINDS,
        estimators=ESTIMATORS,
        line_width=controls.LINE_WIDTH,
        changed=changed,
        widths=widths,
    )
    write_text(folder / html.PAGE, text)
    return folder / html.PAGE


@style.applied()
def write_worths(study: Study, worths: pd.DataFrame, folder: Path) -> Path:
    """Write the worths of a study without ground truth, which has no errors; return the table."""
    note = one_line(f"KITTI folder {study.kitti.name}, without ground truth")
    provenance.write_table(folder / "worth_runs.csv", worths)
    style.save_all({"worth": worth.figure(worths)}, {"worth": worth.table(worths)}, folder, note)
    return folder / "worth.md"


def write_paths(study: Study, runs: pd.DataFrame, folder: Path) -> None:
    """Write the ground truth and repetition 0 of every run in KITTI's and TUM's formats.

    The files are folder/PATHS/kitti/SEQUENCE/RUN.txt and folder/PATHS/tum/SEQUENCE/RUN.txt.
    """
    unshuffled = runs[runs["repetition"] == 0]
    for sequence in study.opened:
        name = sequence.name
        runs_of_sequence = unshuffled[unshuffled["sequence"] == name]
        all_poses = {(name, "truth"): sequence.poses}
        all_poses |= runner.run_poses(runs_of_sequence, folder / RUNS)
        for (_, run), poses in all_poses.items():
            write_kitti_poses(folder / PATHS / "kitti" / name / f"{run}.txt", poses)
            write_tum(folder / PATHS / "tum" / name / f"{run}.txt", poses, sequence.times)


def latex(table: pd.DataFrame) -> str:
    """Return a table as LaTeX, no wider than a column of text; it needs booktabs and graphicx.

    A text between ** is bold.
    """
    if table.empty:
        return ""
    text = table.to_latex(index=False, na_rep="", escape=True, float_format="{:g}".format)
    text = re.sub(r"\*\*(.*?)\*\*", r"\\textbf{\1}", text).replace("±", r"$\pm$")
    width = r"\ifdim\width>\linewidth\linewidth\else\width\fi"
    return f"\\resizebox{{{width}}}{{!}}{{%\n{text}}}\n"


def latex_errors(table: pd.DataFrame, repetitions: int = 1) -> str:
    """Return `comparison.table_errors` as LaTeX: tables of at most FIT sequences.

    Each table has one error and one estimator, which stand in a line above it. A note below it
    tells of means without a deviation, if there are several repetitions.
    """
    parts = []
    for (error, estimator), rows in table.groupby(["error", "estimator"], sort=False):
        sequences = rows.columns.drop(["error", "estimator", "method"])
        for first in range(0, len(sequences), FIT):
            columns = ["method", *sequences[first : first + FIT]]
            text = f"\\noindent {error}, {estimator}\\par\n{latex(rows[columns])}"
            if repetitions > 1 and not rows[columns[1:]].map(lambda cell: "±" in str(cell)).all(
                axis=None
            ):
                text += f"\\par\\noindent {NO_DEVIATION}\\par\n"
            parts.append(text)
    return "\n".join(parts)


def shown_masks(study: Study) -> list[tuple[Sequence, list[FileMasks]]]:
    """Return each sequence with the masks of each source, at the `shown_width`."""
    sources = [source for source in study.sources if source.kind not in UNMASKED]
    return [
        (sequence, [source.masks(sequence, study.shown_width) for source in sources])
        for sequence in study.opened
    ]


def figure_sources(study: Study, runs: pd.DataFrame) -> Figure:
    """Draw the middle frame of the first sequence that has such runs, one row a source.

    A row shows the source's label map (or the frame, if there is none), its mask and the kept
    keypoints, so that a person sees which masks are inverted or lie elsewhere. Own keypoints have
    no mask. Sources whose runs failed are left out.
    """
    drawn = runs[runs["method"].isin(DRAWN)]
    name = drawn["sequence"].iloc[0]
    with_runs = set(drawn.loc[drawn["sequence"] == name, "source"])
    sources = [source for source in study.sources if source.name in with_runs]
    (sequence,) = (sequence for sequence in study.opened if sequence.name == name)
    index = len(sequence) // 2
    frame = sequence.frame(index)
    label_maps = []
    figure, axes = style.frame_panels(frame, len(sources), 3, 1.5 * style.PAGE_WIDTH)
    for (first, second, third), source in zip(np.reshape(axes, (-1, 3)), sources, strict=True):
        style.show_image(first, frame, f"{source.name}: frame {index}")
        if source.kind == "keypoints":
            second.set_axis_off()
            points = own_calls(source.folder).detect(frame, THESIS, sequence.visible(index))
        else:
            masks = source.masks(sequence, study.shown_width)
            if isinstance(masks, LabelMasks):
                label_maps.append(masks.label_map(index))
                colors = style.label_colors(label_maps[-1], frame)
                style.show_image(first, colors, f"{source.name}: label map")
            mask = masks[index]
            style.show_image(second, mask, f"{source.name}: mask", vmin=0, vmax=255)
            points = detect(frame, mask=inside(sequence.visible(index), mask))
        style.show_image(third, frame, f"{source.name}: {len(points)} keypoints")
        third.scatter(*points.T, **style.KEYPOINT)
    if label_maps:
        style.class_legend(figure, *label_maps)
    return figure


def _failed(study: Study, runs: pd.DataFrame) -> pd.DataFrame:
    """Return rows of the summary for sources without any run."""
    names = [source.name for source in study.sources if source.name not in set(runs["source"])]
    return pd.DataFrame({"source": names, "verdict": ["all runs failed"] * len(names)})


def figure_paths(study: Study, runs: pd.DataFrame, sequence: Sequence, folder: Path) -> Figure:
    """Draw the path with all keypoints and that of each source, shifted as for the RMSE."""
    widths = runs["dilation_width"]
    rows = runs[
        (runs["sequence"] == sequence.name)
        & (runs["repetition"] == 0)
        & (runs["estimator"] == compare.judging_estimator(runs))
        & runs["method"].isin(["baseline", "masked", *UNMASKED])
        & (widths.isna() | (widths == study.shown_width))
    ]
    shown = {}
    poses = runner.run_poses(rows, folder / RUNS)
    for row in rows.itertuples():
        label = row.source or compare.METHODS[row.method]
        shown[label] = metrics.shifted(poses[sequence.name, row.run], sequence.poses)
    return paths.figure(shown, sequence.poses, f"sequence {sequence.name}")


def _changed(source: Source) -> str:
    """Return the settings of masks from label maps that differ from the thesis's.

    Such as "; margin 10".
    """
    if not source.has_label_maps:
        return ""
    default = vars(MaskSettings())
    settings = vars(source.settings).items()
    return "".join(f"; {name} {value}" for name, value in settings if value != default[name])
