"""The results of a study with the user's masks: findings, figures, tables and a page.

Tables are also written as LaTeX and figures as PDF, for use in a paper.
"""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from thesis_repro.data.trajectories import read_poses, write_kitti_poses, write_tum
from thesis_repro.errors import InputError, one_line
from thesis_repro.mask_files import LabelMasks, label_map_of
from thesis_repro.odometry import THESIS, keypoints, metrics
from thesis_repro.report import comparison, findings, page, paths, style, tables
from thesis_repro.running import results
from thesis_repro.running.files import write_text
from thesis_repro.study import compare, methods, runner
from thesis_repro.study.jobs import ESTIMATORS
from thesis_repro.study.sources import KINDS, Source
from thesis_repro.study.study import RUNS, Study

PATHS = "paths"  # folder of the estimated paths


@style.applied()
def write(study: Study, runs: pd.DataFrame, folder: Path, warnings: Collection[str] = ()) -> Path:
    """Write the findings, figures, tables and page of a `Study` into a folder.

    Returns the page's path. warnings: lines for the top of the page.
    """
    # `thesis-repro synthesize` leaves a record beside the KITTI folder of an embedded world
    world = results.record(study.kitti.resolve().parent) or {}
    embedded = "train_images" in world
    data = f"KITTI folder {study.kitti.name}"
    if embedded:
        data = "embedded world (rendered)"
    changed = {source.name: _changed(source) for source in study.sources}
    masks = [
        f"{source.name} ({KINDS[source.kind]}{changed[source.name]})" for source in study.sources
    ]
    note = one_line(f"odometry: {data}; masks: {', '.join(masks)}")
    write_paths(study, runs, folder)
    # for texts and tables
    runs = runs.assign(sequence=runs["sequence"].map(one_line))
    table = compare.comparisons(runs)
    write_text(folder / "findings.md", findings.text(runs, table, note, embedded))
    figures = {
        "comparison": comparison.figure_comparison(table),
        "sources": figure_sources(study),
    }
    figures |= {f"paths-{name}": figure_paths(study, name, folder) for name in study.sequences}
    for name, figure in figures.items():
        style.write_figure(figure, folder / f"{name}.pdf")
    numbers = {
        "summary": comparison.table_summary(table, runs),
        "comparison": comparison.table_comparison(table),
        "widths": comparison.table_widths(runs),
        "errors": tables.table_errors(runs),
    }
    for name, rows in numbers.items():
        if name == "summary" and len(rows):  # one column a source fits into a column of text
            rows = rows.set_index("masks").T.rename_axis("masks").reset_index()
        write_text(folder / f"{name}.tex", f"% {note}\n{latex(rows)}")
    numbers["runs"] = runs.round(6)  # hundreds of pages in LaTeX
    names = style.save_all(figures, numbers, folder, note)
    widths = sorted(runs["dilation_width"].dropna().astype(int).unique())
    text = page.build_study(
        folder,
        [("text", "findings"), *names],
        study=study,
        warnings=warnings,
        embedded=embedded,
        kinds=KINDS,
        estimators=ESTIMATORS,
        line_width=methods.LINE_WIDTH,
        changed=changed,
        widths=widths,
    )
    write_text(folder / page.PAGE, text)
    return folder / page.PAGE


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
    """Return a table as LaTeX, as wide as a column of text; it needs booktabs and graphicx."""
    if table.empty:
        return ""
    text = table.to_latex(index=False, na_rep="", escape=True, float_format="{:g}".format)
    return f"\\resizebox{{\\linewidth}}{{!}}{{%\n{text}}}\n"


def figure_sources(study: Study) -> Figure:
    """Draw the middle frame of the first readable sequence, one row a source.

    A row shows the source's label map (or the frame, if there is none), its mask and the kept
    keypoints, so that a person sees which masks are inverted or lie elsewhere.
    """
    for sequence, sequence_masks in study.shown_masks():
        index = len(sequence) // 2
        with suppress(InputError):  # if a frame cannot be read, only the runs of its sequence fail
            frame, masks_by_source = sequence.frame(index), sequence_masks
            break
    label_maps = []
    figure, axes = style.frame_panels(frame, len(masks_by_source), 3, 1.5 * style.PAGE_WIDTH)
    rows = np.reshape(axes, (-1, 3))
    for (first, second, third), source, masks in zip(rows, study.sources, masks_by_source):
        style.show_image(first, frame, f"{source.name}: frame {index}")
        style.show_image(second, np.zeros_like(frame), f"{source.name}: no mask")
        style.show_image(third, frame, "")
        with suppress(InputError):  # the runs report a file that cannot be read
            mask = masks[index]
            if isinstance(masks, LabelMasks):
                label_map = label_map_of(masks, index)
                label_maps.append(label_map)
                colors = style.label_colors(label_map, frame)
                style.show_image(first, colors, f"{source.name}: label map")
            points = keypoints.detect(frame, THESIS, mask)
            style.show_image(second, mask, f"{source.name}: mask", vmin=0, vmax=255)
            third.set_title(f"{source.name}: {len(points)} keypoints")
            third.scatter(*points.T, **style.KEYPOINT)
    if label_maps:
        style.class_legend(figure, *label_maps)
    return figure


def figure_paths(study: Study, name: str, folder: Path) -> Figure:
    """Draw a path with all keypoints and one with each source's masks, shifted as for the RMSE."""
    (true,) = (sequence.poses for sequence in study.opened if sequence.name == name)
    poses_folder = folder / PATHS / "kitti" / name
    shown = {}
    for job in study.shown_jobs(name):
        label = job.source or compare.METHODS[job.method]
        file = poses_folder / f"{job.name}.txt"
        if file.is_file():
            shown[label] = metrics.shifted(read_poses(file), true)
    return paths.figure(shown, true, f"sequence {name}")


def _changed(source: Source) -> str:
    """Return the settings of masks from label maps that differ from the thesis's.

    Such as "; margin 10".
    """
    if source.kind != "labels":
        return ""
    default = vars(type(source.settings)())
    changed = [
        f"{name} {value}" for name, value in vars(source.settings).items() if value != default[name]
    ]
    if not changed:
        return ""
    return f"; {', '.join(changed)}"
