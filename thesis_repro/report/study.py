"""What a study with masks of one's own leaves: findings, figures and tables, the paths of its runs, and one page.

Everything that a paper takes is there in its form: tables as LaTeX, figures as PDF, paths in KITTI's and TUM's form.
"""

from contextlib import suppress
from pathlib import Path

import numpy as np

from thesis_repro import InputError, stages
from thesis_repro.files import atomic, write_text
from thesis_repro.kitti import Sequence, read_poses
from thesis_repro.masks import label_map_of
from thesis_repro.odometry import THESIS, keypoints, metrics
from thesis_repro.report import comparison, page, style, tables, texts, trajectories
from thesis_repro.study import compare, controls, runner, series
from thesis_repro.study.jobs import ESTIMATORS
from thesis_repro.study.sources import KINDS

DIGITS = 6  # of the table of runs


def write(study, runs, folder, warnings=()):
    """Write everything that the runs of a `series.Study` show into a folder; returns the page's path.

    warnings: lines that the page opens with.
    """
    runs = runner.with_boresight_correction(runs, study.kitti, folder / "runs", study.frames)
    table, note = compare.comparisons(runs), data_note(study)
    write_text(folder / "findings.md", texts.findings(runs, table, note))
    figures = {"comparison": comparison.figure_comparison(table), "sources": figure_sources(study)}
    figures |= {f"paths-{name}": figure_paths(study, name, folder) for name in study.sequences}
    numbers = {"comparison": comparison.table_comparison(table), "widths": comparison.table_widths(runs),
               "errors": tables.table_errors(runs), "runs": runs.round(DIGITS)}
    names = save(figures, numbers, folder, note)
    write_text(folder / page.PAGE, page.build_study(
        folder, [("text", "findings"), *names], study=study, warnings=warnings,
        embedded=is_embedded(study.kitti), kinds=KINDS, estimators=ESTIMATORS, line_width=controls.LINE_WIDTH,
        changed={source.name: _changed(source) for source in study.sources},
        widths=sorted(runs["dilation_width"].dropna().astype(int).unique())))
    return folder / page.PAGE


def save(figures, tables, folder, note):
    """`style.save_all`, and the same for a paper: figures as PDF, tables as LaTeX for the package booktabs."""
    for name, figure in figures.items():
        with atomic(folder / f"{name}.pdf") as temporary:
            figure.savefig(temporary, bbox_inches="tight", pad_inches=0.04, metadata={"CreationDate": None})
    for name, table in tables.items():
        latex = table.to_latex(index=False, escape=True, na_rep="", float_format="{:g}".format)
        write_text(folder / f"{name}.tex", f"% {note}\n{latex}")
    return style.save_all(figures, tables, folder, note)


def figure_sources(study):
    """The middle frame of the first sequence: each source's label map, its mask, and the keypoints in that.

    The frame alone stands in place of the label map where there is none.
    """
    for sequence, own in study.masks():
        index = len(sequence) // 2
        with suppress(InputError):  # a frame that cannot be read costs the runs of its sequence alone
            frame, of_sources = sequence.frame(index), own
            break
    label_maps = []
    figure, axes = style.frame_panels(frame, len(of_sources), 3, 1.5 * style.PAGE_WIDTH)
    for (first, second, third), source, masks in zip(np.reshape(axes, (-1, 3)), study.sources, of_sources):
        style.show_image(first, frame, f"{source.name}: frame {index}")
        style.show_image(second, np.zeros_like(frame), f"{source.name}: no mask")
        style.show_image(third, frame, "")
        with suppress(InputError):  # of a file that cannot be read: its runs say so
            mask = masks[index]
            if source.kind == "labels":
                label_maps.append(label_map_of(masks, index))
                style.show_image(first, style.label_colors(label_maps[-1], frame), f"{source.name}: label map")
            points = keypoints.detect(frame, THESIS, mask)
            style.show_image(second, mask, f"{source.name}: mask", vmin=0, vmax=255)
            third.set_title(f"{source.name}: {len(points)} keypoints")
            third.scatter(*points.T, **style.KEYPOINT)
    if label_maps:
        style.class_legend(figure, *label_maps)
    return figure


def figure_paths(study, name, folder):
    """All keypoints and every source's masks over one sequence, one run each, shifted as for the RMSE."""
    true = Sequence(study.kitti, name).subset(study.frames).poses
    files = {job.source or compare.METHODS[job.method]: folder / series.PATHS / "kitti" / name / f"{job.name}.txt"
             for job in study.shown_jobs(name)}
    paths = {label: metrics.shifted(read_poses(file), true) for label, file in files.items() if file.is_file()}
    return trajectories.figure(paths, true, f"sequence {name}")


def is_embedded(kitti):
    """Whether a KITTI folder is that of an embedded world, as `thesis-repro synthesize` writes it."""
    return "train_images" in (stages.record(Path(kitti).absolute().parent) or {})


def data_note(study):
    """One line for captions: where the numbers come from."""
    frames = "embedded world (rendered)" if is_embedded(study.kitti) else f"KITTI folder {study.kitti.name}"
    masks = ", ".join(f"{source.name} ({KINDS[source.kind]}{_changed(source)})" for source in study.sources)
    return f"odometry: {frames}; masks: {masks}"


def _changed(source):
    """The settings of masks from label maps that are not the thesis's, as "; margin 10"."""
    default = vars(type(source.settings)())
    changed = [f"{name} {value}" for name, value in vars(source.settings).items() if value != default[name]]
    return f"; {', '.join(changed)}" if changed and source.kind == "labels" else ""
