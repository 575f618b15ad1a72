"""What a study with masks of one's own leaves: findings, figures, tables, and one page that shows them."""

from pathlib import Path

from thesis_repro import stages
from thesis_repro.files import write_text
from thesis_repro.report import comparison, page, style, tables, texts
from thesis_repro.study import compare, controls, runner
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
    style.save_table(runs.round(DIGITS), folder, "runs", note)
    names = style.save_all(comparison.figures(table, runs), {
        "comparison": comparison.table_comparison(table), "widths": comparison.table_widths(runs),
        "errors": tables.table_errors(runs)}, folder, note)
    write_text(folder / page.PAGE, page.build_study(
        folder, [("text", "findings"), *names], study=study, warnings=warnings,
        embedded=is_embedded(study.kitti), kinds=KINDS, estimators=ESTIMATORS, line_width=controls.LINE_WIDTH,
        changed={source.name: _changed(source) for source in study.sources},
        widths=sorted(runs["dilation_width"].dropna().astype(int).unique())))
    return folder / page.PAGE


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
