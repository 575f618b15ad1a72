"""The results of a study with the user's masks: findings, figures, tables and a page.

Figures are also written as PDF, across a page and in one column of a paper.
"""

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from keypoint_study import comparisons, runner
from keypoint_study.comparisons import BROUGHT
from keypoint_study.jobs import ESTIMATOR_TITLES
from keypoint_study.methods import CONTROL_WIDTH
from keypoint_study.plan import RUNS, Study
from keypoint_study.report import comparison, html, style
from keypoint_study.report.findings import findings_of
from keypoint_study.report.paths import figure_of_paths
from keypoint_study.report.style import COLUMN_WIDTH, PAGE_WIDTH, Artefact
from keypoint_study.sources import KINDS, FileMasks, Source, own_calls
from thesis_repro import checks
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.sequence import Sequence
from thesis_repro.data.trajectories import write_kitti_poses, write_tum
from thesis_repro.errors import one_line
from thesis_repro.masks import MaskSettings
from thesis_repro.masks.folders import LabelMasks
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.loop import detect
from thesis_repro.odometry.runs import inside
from thesis_repro.running import program, provenance
from thesis_repro.running.files import write_text

PATHS = "paths"  # folder of the estimated paths


def make(study: Study, folder: Path, processes: int = 1, scheduler: str | None = None) -> int:
    """Run a study, and write its page and tables; what is in the folder is kept.

    Says what it finds doubtful, and where the page is. Returns 1 if a run failed, otherwise 0.
    """
    with provenance.claimed(folder):
        warnings = []
        for sequence, masks in shown_masks(study):
            warnings += program.warn(checks.input_warnings(sequence, masks))
        outcome = study.run(folder, processes, scheduler)
        runs = outcome.table
        study = replace(study, sequences=tuple(runs["sequence"].unique()))
        warnings += outcome.warnings + program.warn(_doubts(study, runs))
        page = write(study, runs, folder, warnings)
    made = f"{len(runs):,} runs, {len(outcome.reasons):,} failed"
    program.summary(f"{made}; open {page} in a browser", outcome.kept)
    return int(bool(outcome.reasons))


def _doubts(study: Study, runs: pd.DataFrame) -> Iterator[str]:
    """Yield warnings of the runs, one of each sequence and source at the shown width."""
    shown = runs["dilation_width"].isna() | (runs["dilation_width"] == study.shown_width)
    of_shown = runs[shown & runs["method"].isin(("baseline", *BROUGHT))]
    for run in of_shown.drop_duplicates(["sequence", "source"]).itertuples():
        name = f"{run.sequence} {run.source}".strip()
        yield from checks.run_warnings(name, run.frames, run.flagged)


@style.applied()
def write(study: Study, runs: pd.DataFrame, folder: Path, warnings: Collection[str] = ()) -> Path:
    """Write the findings, figures, tables and page of a `Study` into a folder.

    Returns the page's path. warnings: lines for the top of the page.
    """
    # `thesis-repro synthesize` leaves a record beside the KITTI folder of an embedded world
    embedded = "train_images" in (provenance.record(study.kitti.resolve().parent) or {})
    data = "embedded world (rendered)" if embedded else f"KITTI folder {study.kitti.name}"
    changed = {source.name: _changed(source) for source in study.sources}
    brought = [
        f"{source.name} ({KINDS[source.kind]}{changed[source.name]})" for source in study.sources
    ]
    note = one_line(f"odometry: {data}; compared: {', '.join(brought)}")
    write_paths(study, runs, folder)
    named = runs.assign(sequence=runs["sequence"].map(one_line))  # for texts and tables
    table = comparisons.comparisons_of(named)
    text_of_findings = findings_of(named, table, note, embedded)
    findings = Artefact("findings", "What the runs show", "", text_of_findings)
    shown = [html.described(findings, style.save(findings, folder, note))]
    for figure in figures_of(study, runs, table, folder, COLUMN_WIDTH):
        # a tight box would make it wider or narrower than the column
        style.write_figure(figure.content, folder / f"{figure.name}-column.pdf", bbox_inches=None)
        plt.close(figure.content)
    for figure in figures_of(study, runs, table, folder, PAGE_WIDTH):
        style.write_figure(figure.content, folder / f"{figure.name}.pdf")
        files = style.save(figure, folder, note)
        files += [f"{figure.name}.pdf", f"{figure.name}-column.pdf"]
        shown.append(html.described(figure, files))
    for artefact in tables_of(named, table):
        files = style.save(artefact, folder, note)
        if files:  # of a table with rows
            shown.append(html.described(artefact, files))
    text = html.page_of(
        shown,
        study=study,
        failed=[source.name for source in study.sources if source.name not in set(runs["source"])],
        warnings=warnings,
        embedded=embedded,
        kinds=KINDS,
        estimators=ESTIMATOR_TITLES,
        line_width=CONTROL_WIDTH,
        changed=changed,
        widths=sorted(runs["dilation_width"].dropna().astype(int).unique()),
    )
    write_text(folder / html.PAGE, text)
    return folder / html.PAGE


def figures_of(
    study: Study, runs: pd.DataFrame, table: pd.DataFrame, folder: Path, width: float
) -> Iterator[Artefact]:
    """Draw the figures of a study, of a width in inches.

    table: `comparisons_of` the runs.
    """
    sources = [""]
    if table.loc[table["method"] == "masked", "source"].nunique() > 1:
        is_control = table["method"].isin(comparisons.SEGMENTATION_FREE_CONTROLS)
        sources += list(table.loc[is_control, "source"].unique())
    for source in sources:
        if not comparison.judged(table, source).empty:
            yield comparison.figure_of_ratios(table, source, width)
    if runs["method"].isin(BROUGHT).any():
        yield figure_of_sources(study, runs, width)
    for sequence in study.opened:
        yield figure_of_sequence(study, runs, sequence, folder, width)


def tables_of(runs: pd.DataFrame, table: pd.DataFrame) -> list[Artefact]:
    """Return the tables of a study. table: `comparisons_of` the runs."""
    caption = "Settings, errors, failed and flagged frames."
    return [
        comparison.table_of_errors(table, runs),
        comparison.table_of_widths(runs),
        comparison.long_table_of_ratios(table),
        Artefact("runs", "Every run", caption, runs.round(6), for_programs=True),
    ]


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


def shown_masks(study: Study) -> list[tuple[Sequence, list[FileMasks]]]:
    """Return each sequence with the masks of each source, at the `shown_width`."""
    sources = [source for source in study.sources if source.kind != "keypoints"]
    return [
        (sequence, [source.masks(sequence, study.shown_width) for source in sources])
        for sequence in study.opened
    ]


def figure_of_sources(study: Study, runs: pd.DataFrame, width: float = PAGE_WIDTH) -> Artefact:
    """Draw the middle frame of the first sequence that has such runs, one row a source.

    A row shows the source's label map (or the frame, if there is none), its mask and the kept
    keypoints, so that a person sees which masks are inverted or lie elsewhere. In one column of a
    paper, sources stand side by side. Own keypoints have no mask. Sources whose runs failed are
    left out. width: inches.
    """
    drawn = runs[runs["method"].isin(BROUGHT)]
    name = drawn["sequence"].iloc[0]
    with_runs = set(drawn.loc[drawn["sequence"] == name, "source"])
    sources = [source for source in study.sources if source.name in with_runs]
    (sequence,) = (sequence for sequence in study.opened if sequence.name == name)
    index = len(sequence) // 2
    figure, panels = _panels_of_sources(sequence.frame(index), len(sources), width)
    label_maps = []
    for of_source, source in zip(panels, sources):
        label_maps += _draw_source(of_source, source, sequence, index, study.shown_width)
        if width > COLUMN_WIDTH:
            for panel in of_source:
                if panel.get_title():
                    panel.set_title(f"{source.name}: {panel.get_title()}")
        else:
            of_source[0].set_title(f"{source.name}\n{of_source[0].get_title()}")
            for panel in of_source:
                panel.title.set_fontsize(6)
    if label_maps:
        style.class_legend(figure, *label_maps)
    return Artefact(
        "sources",
        "The masks and keypoints",
        "The middle frame of the first sequence. Each source has a row: its label map (or the frame, "
        "if there is none), its mask, and the keypoints that the detector (Shi-Tomasi) finds inside "
        "it. Own keypoints have no mask; points that lie elsewhere than corners hint at rows and "
        "columns in the wrong order. A mask keeps keypoints where it is white: if that is where it "
        "should discard them, the masks are inverted, and --invert turns them round.",
        figure,
    )


def _panels_of_sources(
    frame: np.ndarray, count: int, width: float
) -> tuple[plt.Figure, np.ndarray]:
    """Return a figure and three of its panels for each source, (count, 3)."""
    if width > COLUMN_WIDTH:
        figure, axes = style.frame_panels(frame, count, 3, 1.5 * width)
        return figure, np.reshape(axes, (count, 3))
    # up to three sources side by side, so that it takes half a page
    columns = min(3, count)
    figure, axes = style.frame_panels(frame, 3 * -(-count // columns), columns, width)
    panels = np.reshape(axes, (-1, 3, columns)).swapaxes(1, 2).reshape(-1, 3)
    for unused in panels[count:].flat:
        unused.set_axis_off()
    return figure, panels[:count]


def _draw_source(
    panels: np.ndarray, source: Source, sequence: Sequence, index: int, width: int | None
) -> list[np.ndarray]:
    """Draw what a source has for one frame on three panels; return its label maps: one or none."""
    first, second, third = panels
    frame, visible = sequence.frame(index), sequence.visible(index)
    label_maps: list[np.ndarray] = []
    style.show_image(first, frame, f"frame {index}")
    if source.kind == "keypoints":
        second.set_axis_off()
        points = own_calls(source.folder).detect(frame, THESIS, visible)
    else:
        masks = source.masks(sequence, width)
        if isinstance(masks, LabelMasks):
            label_maps.append(masks.label_map(index))
            style.show_image(first, style.label_colors(label_maps[0], frame), "label map")
        mask = masks[index]
        style.show_image(second, mask, "mask", vmin=0, vmax=255)
        style.outline(second, mask)
        points = detect(frame, mask=inside(visible, mask))
    style.show_image(third, frame, f"{len(points)} keypoints")
    third.scatter(*points.T, **style.KEYPOINT)
    return label_maps


def figure_of_sequence(
    study: Study, runs: pd.DataFrame, sequence: Sequence, folder: Path, width: float = PAGE_WIDTH
) -> Artefact:
    """Draw the path with all keypoints and that of each source, shifted as for the RMSE."""
    widths = runs["dilation_width"]
    rows = runs[
        (runs["sequence"] == sequence.name)
        & (runs["repetition"] == 0)
        & (runs["estimator"] == comparisons.judging_estimator(runs))
        & runs["method"].isin(["baseline", *BROUGHT])
        & (widths.isna() | (widths == study.shown_width))
    ]
    shown = {}
    poses = runner.run_poses(rows, folder / RUNS)
    for row in rows.itertuples():
        label = row.source or comparisons.METHOD_TITLES[row.method]
        shown[label] = metrics.shifted(poses[sequence.name, row.run], sequence.poses)
    return Artefact(
        f"paths-{sequence.name}",
        f"Paths of sequence {sequence.name}",
        "All keypoints and each source (masks of the tested width), one run each, aligned with the "
        "true path at frame 1 as for the RMSE.",
        figure_of_paths(shown, sequence.poses, f"sequence {sequence.name}", width),
    )


def _changed(source: Source) -> str:
    """Return the settings of masks from label maps that differ from the thesis's.

    Such as "; margin 10".
    """
    if not source.has_label_maps:
        return ""
    default = vars(MaskSettings()) | {"ids": LABEL_IDS}
    settings = vars(source.settings) | {"ids": source.ids}
    changed = [f"; {name} {value}" for name, value in settings.items() if value != default[name]]
    return "".join(changed)
