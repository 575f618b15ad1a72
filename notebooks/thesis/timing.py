"""Time a run for each dilation width, and each stage from a frame's file to its pose.

The widths are timed as in the thesis (Figure 4.17). The stages include the network, as Section
5.2.2 asks for. They are timed as in a live system: one frame after the other, the network on one
image at a time, all cores.

Figures and tables in git have the times of git, which `make timings` measures anew: those of the
embedded world in figures/timings, which all its runs show, those of the evidence in
figures/kitti_excerpts/timings. So a run on another machine changes no sentence. Other frames are
timed once, in the folder of their figures.
"""

import platform
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import date
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from keypoint_study.best_width import percent_change
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.report import style
from keypoint_study.sources import Source
from thesis import REPORTED, artefacts, real_frames
from thesis.run_settings import ROOT, Settings, cores
from thesis_repro import masks, odometry
from thesis_repro.data.cityscapes import resize_bilinear
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import folders
from thesis_repro.odometry.runs import Masks
from thesis_repro.running.files import needed, progress, write_text

TURNS = 2  # of each run, of which the fastest counts
FRAMES = 20  # on which the stages are timed
WARM_UP = 3  # frames before them, which load compiled code and fill caches


def seconds_of(sequence: Sequence, masks: Masks | None = None, threads: int = 1) -> float:
    """Return the seconds that the odometry and its masks take in a run of its own.

    The runs of `keypoint_study.runner` share work, so none of them can be timed. The first two
    steps load code and are not counted; nor are frames' files and the network, as in Section 4.2.
    threads: of OpenCV.
    """
    cv2.setNumThreads(threads)
    seconds = []
    for _ in range(TURNS):
        folders.forget_edges()  # which the run before has found
        frames = odometry.run(sequence, masks=masks).frames
        seconds.append(frames.filter(like="_seconds")[2:].to_numpy().sum())
    cv2.setNumThreads(-1)  # as many as there are cores
    return min(seconds)


def seconds_of_widths(
    sequences: list[Sequence], source: Source, widths: Iterable[int]
) -> pd.DataFrame:
    """Time all keypoints, and masks of every width, on one thread and on all cores.

    Returns one row a run, with sequence, method ("baseline" or "masked"), dilation_width, threads
    and seconds. source: of the masks.
    """
    rows = []
    threads = sorted({1, cores()})
    timed = list(product(sequences, [0, *widths], threads))  # 0: no mask
    for sequence, width, count in progress(timed, "timing", unit="run"):
        masks = source.masks(sequence, width) if width else None
        method = "masked" if width else "baseline"
        seconds = seconds_of(sequence, masks, count)
        rows.append([sequence.name, method, width, count, seconds])
    columns = ["sequence", "method", "dilation_width", "threads", "seconds"]
    return pd.DataFrame(rows, columns=columns)


def time_savings(seconds: pd.DataFrame) -> pd.DataFrame:
    """Return the change of time (%) from all keypoints for each dilation width (Equation 4.2).

    It is negative if time is saved. There is one column for each number of threads ("1 thread", "2
    threads"). seconds: of `seconds_of_widths`; they are added over the sequences.
    """
    columns = {}
    for threads, rows in seconds.groupby("threads"):
        baseline = rows.loc[rows["method"] == "baseline", "seconds"].sum()
        of_widths = rows[rows["method"] == "masked"].groupby("dilation_width")["seconds"].sum()
        name = f"{threads} threads" if threads > 1 else "1 thread"
        columns[name] = percent_change(of_widths, baseline)
    return pd.DataFrame(columns)


def figure_4_17(seconds: pd.DataFrame, embedded: bool) -> plt.Figure:
    """Figure 4.17: the change of time, with masks of each width, of all sequences and of each one.

    seconds: of `seconds_of_widths`. embedded: without the thesis's numbers, which are KITTI's.
    """
    figure, axes = style.new_figure(height=3.6)
    together = time_savings(seconds).rename(int)
    count = seconds["sequence"].nunique()
    labels = [f"all {count} timed sequences, {name}" for name in together]
    together.set_axis(labels, axis=1).plot.bar(
        ax=axes, color=[style.MASKED, style.SKY], rot=0, width=0.75, legend=False
    )
    thread = together.columns[0]
    if count > 1:
        of_each = {name: time_savings(rows)[thread] for name, rows in seconds.groupby("sequence")}
        middles = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches[: len(together)]]
        dots: dict[str, Any] = {"color": "black", "markersize": 4, "alpha": 0.5}
        dots |= {"markeredgewidth": 0, "label": f"a single sequence, {thread}"}
        axes.plot(middles, pd.DataFrame(of_each), "o", **dots)
    if not embedded:
        least, most = REPORTED["headline_claims"]["time_savings_percent"]
        claim = f"the thesis, on KITTI: {least} to {most} % saved with its best widths"
        axes.axhspan(-most, -least, color=style.GRAY, alpha=0.5, label=claim)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(xlabel="dilation width (pixels)", ylabel="change of time (%)")
    style.legend_below(figure, [axes], 2)
    return figure


def time_stages(
    sequence: Sequence, model: Any, width: int = CONTROL_WIDTH, frames: int = FRAMES
) -> pd.DataFrame:
    """Time each stage of a frame, with all keypoints and with masks.

    Returns a table of method, stage, milliseconds (medians).
    Stages: read (the frame's file), segmentation (resize to the model's input, network, class of
    every pixel), mask (label map to 320x320, edges, dilation), detection, tracking, pose (essential
    matrix, then rotation and translation). model: a Keras model of `segmentation`. width: of the
    masks, pixels. frames: number of those that are timed.
    """
    from thesis_repro.segmentation import prediction  # TensorFlow takes seconds to load

    sequence = sequence.subset(WARM_UP + frames)
    height, columns, channels = model.input_shape[1:]
    seconds, made = [], []
    for index in progress(range(len(sequence)), "timing"):
        times = [time.perf_counter()]
        frame = sequence.frame(index)
        times.append(time.perf_counter())
        image = resize_bilinear(frame, (height, columns))[..., None].repeat(channels, axis=2)
        label_map = prediction.predict(model, image[None])[0]
        times.append(time.perf_counter())
        small = (prediction.SIZE,) * 2  # in which label maps are written
        label_map = cv2.resize(label_map, small, interpolation=cv2.INTER_NEAREST)
        made.append(masks.keypoint_mask(label_map, frame.shape, width))
        times.append(time.perf_counter())
        seconds.append(np.diff(times))
    stages = pd.DataFrame(seconds, columns=["read", "segmentation", "mask"])
    medians = {}
    for method, frame_masks in {"all keypoints": None, f"masked, width {width}": made}.items():
        steps = odometry.run(sequence, masks=frame_masks).frames
        table = stages.assign(
            detection=steps["detect_seconds"],
            tracking=steps["track_seconds"],
            pose=steps["essential_seconds"] + steps["pose_seconds"],
        )
        medians[method] = 1000 * table[WARM_UP:].median()
    medians["all keypoints"][["segmentation", "mask"]] = np.nan
    by_stage = pd.DataFrame(medians).stack().dropna().rename_axis(["stage", "method"])
    return by_stage.rename("milliseconds").reset_index()[["method", "stage", "milliseconds"]]


def table_of_stages(stages: pd.DataFrame) -> pd.DataFrame:
    """Return one row a stage and one column a method, their sums, and the frames a second.

    stages: of `time_stages`.
    """
    budget = stages.pivot(index="stage", columns="method", values="milliseconds")
    budget = budget.loc[stages["stage"].unique(), stages["method"].unique()]
    sums = pd.DataFrame({"all stages (ms)": budget.sum(), "frames a second": 1000 / budget.sum()})
    budget = pd.concat([budget.round(2).rename("{} (ms)".format), sums.T.round(1)])
    return budget.rename_axis("stage").rename_axis(None, axis=1).reset_index()


def folder(settings: Settings) -> Path:
    """Return the folder of the times that a run's figures show: in git for figures in git."""
    if settings.kitti_is_embedded:
        return ROOT / "figures" / "timings"
    if real_frames.is_evidence(settings):
        return real_frames.FOLDER / "timings"
    return settings.figures / "timings"


def times(
    settings: Settings,
    name: str,
    measure: Callable[[], pd.DataFrame] | None = None,
    anew: bool = False,
) -> pd.DataFrame:
    """Return the times that a run's figures show, and what `told` tells of them.

    measure: measures them, if the frames of the run were never timed, or anew; then they are
    written. Raises InputError if there are none.
    """
    path = folder(settings) / f"{name}.csv"
    if measure and (anew or not path.is_file()):
        table = measure().assign(**circumstances(settings))
        write_text(path, table.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
    return pd.read_csv(needed(path, "08_results"), dtype={"sequence": str})


def of_run(
    settings: Settings, sequences: list[Sequence], source: Source, width: int, anew: bool = False
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return `times` of a run: of `seconds_of_widths`, and of `time_stages`.

    source: of the masks. width: pixels, of the masks in the stages.
    """
    shortened = [sequence.subset(settings.sizes.timed_frames) for sequence in sequences]
    widths = sorted({*settings.sizes.widths, width})
    seconds = times(settings, "seconds", lambda: seconds_of_widths(shortened, source, widths), anew)
    stages = times(
        settings, "budget", lambda: time_stages(sequences[0], artefacts.used_model(), width), anew
    )
    return seconds, stages


def circumstances(settings: Settings) -> dict[str, str]:
    """Return where, when and on what times are measured now: columns of their tables."""
    sizes = settings.sizes
    network = f"{sizes.image_size}x{sizes.image_size} pixels, {sizes.base_filters} filters"
    if settings.uses_shipped_model:
        network = "the model in the package"
    return {
        "processor": processor(),
        "date": date.today().isoformat(),
        "version": version("thesis-repro"),
        "network": network,
    }


def told(times: pd.DataFrame) -> str:
    """Return one line on where, when and on what times were measured. times: of `times`."""
    first = times.iloc[0]
    return (
        f"timed on {first['processor']}; {first['date']}, version {first['version']}; "
        f"network: {first['network']}"
    )


def processor() -> str:
    """Return the name of this machine's processor, and its number of cores in use."""
    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):  # on Linux these are only "x86_64"
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(": ", 1)[1] for line in lines if line.startswith("model name"))
    return f"{name}, {cores()} cores"
