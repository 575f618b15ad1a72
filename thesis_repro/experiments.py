"""The odometry runs behind chapter 4: every sequence with all keypoints, with masks of each width, and plainly reduced;
and the controls, which ask whether it is the segmentation that helps.

Each finished run is one CSV file, so that a stopped or failed series goes on where it was.
"""

import hashlib
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import InputError, cluster, controls, metrics, odometry, stages
from thesis_repro.cityscapes import read_label_map
from thesis_repro.files import listed, progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks, forget_edges

# what a finished run depends on
CODE = ("controls", "experiments", "five_point", "keypoints", "kitti", "masks", "odometry", "pose", "ransac")
CONTROL_WIDTH = 10  # pixels: the width of A.8 and Figure 3.6, chosen before any run
PIECES = 4  # passes for each of several workers, at the least
POSES = ("all", "refined")  # the thesis's estimator, and the one with the far smaller spread


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence. What is None or left out is as in the thesis.

    variant: "baseline", "masked" or "reduced" as in the thesis, or one of the controls.
    dilation_width: pixels, of masks. max_keypoints, min_distance: of the detector.
    pose: "all" or "refined", see OdometrySettings.
    repetition: 0 takes the correspondences in the order in which they come, which is the thesis's single run; any
    other number is the seed that shuffles them.
    """

    sequence: str
    variant: str
    dilation_width: int | None = None
    max_keypoints: int | None = None
    min_distance: float | None = None
    pose: str = "all"
    repetition: int = 0

    @property
    def name(self):
        """Unique in its sequence, and the stem of its file: masked-05-0, mirrored-10-refined-1, spread-7.5-0."""
        width = None if self.dilation_width is None else f"{self.dilation_width:02d}"
        distance = None if self.min_distance is None else f"{self.min_distance:g}"
        pose = None if self.pose == "all" else self.pose
        parts = (self.variant, width, self.max_keypoints, distance, pose, self.repetition)
        return "-".join(str(part) for part in parts if part is not None)


def first_jobs(names, widths, repetitions=1):
    """The thesis's runs that depend on no other: baseline and masks of every width, for each sequence."""
    return [Job(name, variant, width, repetition=repetition) for name in names
            for variant, width in (("baseline", None), *(("masked", width) for width in widths))
            for repetition in range(repetitions)]


def mask_control_jobs(kitti, names, repetitions=1):
    """The controls that depend on no other run, under both estimators; baseline and masks under the refined one.

    The true label maps take part where a sequence has them, in a folder labels_0 beside its frames.
    """
    jobs = []
    for name in names:
        jobs += [Job(name, variant, width, pose="refined", repetition=repetition)
                 for variant, width in (("baseline", None), ("masked", CONTROL_WIDTH))
                 for repetition in range(repetitions)]
        jobs += [Job(name, variant, CONTROL_WIDTH, pose=pose, repetition=repetition)
                 for variant in controls.MASKS
                 if variant != "true-labels" or controls.true_labels(kitti, name).is_dir()
                 for pose in POSES for repetition in range(repetitions)]
    return jobs


def best_widths(summary):
    """The width with the lowest RMSE of each sequence, as the thesis chooses it (Section 4.2), and its means.

    One row a sequence: dilation_width, frames, rmse, mae, mean_keypoints, means over the repetitions.
    The width is chosen by its error on the very sequence it is then judged on: a best of 15, not a test.
    """
    masked = summary[(summary["variant"] == "masked") & (summary["pose"] == "all")]
    means = masked.groupby(["sequence", "dilation_width"])[["frames", "rmse", "mae", "mean_keypoints"]].mean()
    best = means.loc[means.groupby("sequence")["rmse"].idxmin()].reset_index("dilation_width")
    return best.astype({"dilation_width": int, "frames": int}).sort_index()


def reduced_jobs(summary):
    """The detector limited to each sequence's mean number of keypoints at its best width (Figure 4.12)."""
    return [Job(name, "reduced", max_keypoints=_whole(row["mean_keypoints"]), repetition=repetition)
            for name, row in best_widths(summary).iterrows() for repetition in _repetitions(summary)]


def keypoint_control_jobs(summary, kitti, frames=None):
    """As many keypoints as the masks of CONTROL_WIDTH leave, without a mask: the strongest, or spread out.

    "fewer" limits their number; "spread" keeps them farther apart.
    """
    masked = summary[(summary["variant"] == "masked") & (summary["dilation_width"] == CONTROL_WIDTH)]
    jobs = []
    for name, number in masked.groupby("sequence")["mean_keypoints"].mean().items():
        distance = controls.min_distance(Sequence(kitti, name).subset(frames), number)
        jobs += [Job(name, variant, pose=pose, repetition=repetition, **setting)
                 for variant, setting in (("fewer", {"max_keypoints": _whole(number)}),
                                          ("spread", {"min_distance": distance}))
                 for pose in POSES for repetition in _repetitions(summary)]
    return jobs


def _whole(number):
    return max(1, round(number))  # 0 would lift the detector's limit


def _repetitions(summary):
    return sorted({int(repetition) for repetition in summary["repetition"]})


def run(jobs, kitti, labels, folder, *, frames=None, processes=1, scheduler=None, settings=odometry.THESIS):
    """Run the jobs that have no result yet; returns the summary of all that succeeded, one row a job.

    kitti: the odometry root. labels: folder with one folder of label maps a sequence. folder: where results are kept.
    frames: how many of each sequence, None for all. processes: how many work at once on this machine.
    scheduler: address of a Dask scheduler ("tcp://host:8786"); its workers do the work then, with the same results.
    They need this package, and the three folders under the same paths. One thread a worker is best.

    Jobs over one sequence go over it together (`odometry.run_many`: the bits of separate runs at a fraction of the
    cost), in as many passes as it takes to keep everyone busy. A job that fails is printed with its reason and does
    not stop the others. What was running when everything stopped goes on from its checkpoint.
    """
    jobs = list(dict.fromkeys(jobs))
    sequences = _open(jobs, kitti, labels, folder, frames, settings)
    failures = {}
    with cluster.open_pool(processes, scheduler) as pool:
        passes = _passes(jobs, sequences, folder, pool.size)
        threads = -(-pool.size // max(1, len(passes)))
        calls = [(one, kitti, labels, folder, frames, settings, stages.made_from(folder / one[0].sequence), threads)
                 for one in passes]
        for one, failed in progress(pool.run(_run_pass, calls), "odometry", total=len(passes), unit="pass"):
            failures |= failed if isinstance(failed, dict) else dict.fromkeys(passes[one], failed)
    for (name, reason), names in _by_reason(failures).items():
        more = f" and {len(names) - 3} more" * (len(names) > 3)
        print(f"sequence {name}, {', '.join(names[:3])}{more}: failed: {reason}")
    done = [job for job in jobs if _result(folder, job).is_file()]
    if not done:
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {next(iter(failures.values()))}")
    return pd.DataFrame([_summarize(job, sequences[job.sequence], folder) for job in done])


def _by_reason(failures):
    names = {}
    for job, reason in failures.items():
        names.setdefault((job.sequence, reason), []).append(job.name)
    return names


def _open(jobs, kitti, labels, folder, frames, settings):
    """The jobs' sequences by name; what the folder holds of other data, settings or code is deleted."""
    sequences = {name: Sequence(kitti, name).subset(frames) for name in sorted({job.sequence for job in jobs})}
    for name, sequence in sequences.items():
        true_labels = controls.true_labels(kitti, name)
        stages.stage(folder / name, **_versions(), frames=stages.listing(sequence.frame_paths),
                     poses=stages.content(sequence.root / "poses" / f"{name}.txt"),
                     labels=stages.made_from(labels / name), settings=asdict(settings),
                     true_labels=stages.listing(listed(true_labels)) if true_labels.is_dir() else None)
    return sequences


def _versions():
    return {"code": stages.code(*CODE), "opencv": cv2.__version__}


def _passes(jobs, sequences, folder, workers):
    """What is to be run, as lists of jobs, each for one pass over its sequence; the longest first.

    A pass that has a checkpoint goes on as it was. The rest is cut into pieces of at most 1 / PIECES of a worker's
    share, so that no worker is alone at the end; jobs with the same keypoints stay together, since they share most.
    A worker on its own takes each sequence whole.
    """
    passes, groups = [], {}
    for name in sequences:
        of_name = {job.name: job for job in jobs if job.sequence == name}
        waiting = {key: job for key, job in of_name.items() if not _result(folder, job).is_file()}
        for path in sorted((folder / name).glob("pass-*.json")):
            keys = json.loads(path.read_text(encoding="utf-8"))
            if waiting.keys().isdisjoint(keys):
                if of_name.keys() >= set(keys):  # all have their results
                    _forget_pass(path)
            elif _state(path).is_file() and of_name.keys() >= set(keys):
                passes.append([of_name[key] for key in keys])
                waiting = {key: job for key, job in waiting.items() if key not in keys}
        groups[name] = {}
        for job in waiting.values():
            groups[name].setdefault(replace(job, pose="", repetition=0), []).append(job)
    everything = sum(len(groups[name]) * len(sequences[name]) for name in groups)
    for name, of_name in groups.items():
        of_name = list(of_name.values())
        share = len(of_name) * len(sequences[name]) / max(everything, 1)
        pieces = min(len(of_name), math.ceil(share * (PIECES * workers if workers > 1 else 1)))
        for index in range(pieces):
            start, stop = (index * len(of_name) // pieces, (index + 1) * len(of_name) // pieces)
            passes.append([job for group in of_name[start:stop] for job in group])
    return sorted(passes, key=lambda one: -len(one) * len(sequences[one[0].sequence]))


def _pass_file(jobs, folder):
    """The list of what goes over a sequence together; beside it lies the checkpoint."""
    digest = hashlib.sha256("\n".join(job.name for job in jobs).encode()).hexdigest()[:12]
    return folder / jobs[0].sequence / f"pass-{digest}.json"


def _state(pass_file):
    return pass_file.with_suffix(".state")


def _forget_pass(pass_file):
    _state(pass_file).unlink(missing_ok=True)
    pass_file.unlink(missing_ok=True)


def _result(folder, job):
    return folder / job.sequence / f"{job.name}.csv"


def _settings(job, settings):
    changes = {"max_keypoints": job.max_keypoints, "min_distance": job.min_distance,
               "permute": job.repetition or None, "pose": job.pose}
    return replace(settings, **{name: value for name, value in changes.items() if value is not None})


def _masks(job, sequence, labels):
    if job.variant == "masked":
        return LabelMasks(labels / job.sequence, sequence, job.dilation_width)
    if job.variant in controls.MASKS:
        return controls.masks(job.variant, labels / job.sequence, sequence, job.dilation_width)
    return None


def _variants(jobs, sequence, labels, settings):
    """What the odometry needs to know of each job, {job: (settings, masks)}, and {job: reason} of those it cannot run.

    Jobs with the same masks get the same object: so `run_many` knows that they share the work.
    """
    made, variants, failures = {}, {}, {}
    for job in jobs:
        source = (job.variant, job.dilation_width)
        if source not in made:
            try:
                made[source] = _masks(job, sequence, labels)
                for path in [] if made[source] is None else made[source].paths:
                    _check_label_map(path)  # here, since in the middle of a pass it would stop all of it
            except InputError as error:
                made[source] = error
        if isinstance(made[source], InputError):
            failures[job] = str(made[source])
        else:
            variants[job] = _settings(job, settings), made[source]
    _check_label_map.cache_clear()
    return variants, failures


@lru_cache(maxsize=None)
def _check_label_map(path):
    read_label_map(path)


def _run_pass(jobs, kitti, labels, folder, frames, settings, record, threads):
    """Run jobs of one sequence in one pass, here or on another machine; returns {job: reason} of those that failed."""
    cv2.setNumThreads(1)  # the processes already use every core
    name, pass_file, failures = jobs[0].sequence, _pass_file(jobs, folder), {}
    try:
        _check_machine(folder / name, record)
        sequence = Sequence(kitti, name).subset(frames)
        variants, failures = _variants(_waiting(jobs, pass_file, folder), sequence, labels, settings)
        if not variants:  # or Dask does again what it lost the answer of
            return failures
        write_text(pass_file, json.dumps([job.name for job in jobs]))
        results = odometry.run_many(sequence, {job.name: variant for job, variant in variants.items()},
                                    checkpoint=_state(pass_file), workers=threads)
        for job in variants:
            if not _result(folder, job).is_file():
                write_text(_result(folder, job), results.pop(job.name).frames.to_csv(index=False))
        _forget_pass(pass_file)
    except Exception as error:  # whatever it is, the others go on and the reason is reported
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        failures = dict.fromkeys((job for job in jobs if not _result(folder, job).is_file()), reason) | failures
    return failures


def _waiting(jobs, pass_file, folder):
    """The jobs without a result; all of them where a checkpoint of all of them is there to go on from."""
    if _state(pass_file).is_file():
        return jobs
    return [job for job in jobs if not _result(folder, job).is_file()]


def _check_machine(folder, record):
    if not (folder / stages.RECORD).is_file() or stages.made_from(folder) != record:
        raise InputError(f"{folder}: this worker does not see what the others see there; all of them need the same "
                         "folders under the same paths")
    made_from = json.loads((folder / stages.RECORD).read_text(encoding="utf-8"))
    if any(made_from[key] != value for key, value in _versions().items()):
        raise InputError("this worker has another version of thesis_repro or of OpenCV; install the same on all")


def time_runs(jobs, kitti, labels, folder, *, frames, processes=1, settings=odometry.THESIS):
    """What each job costs as a run of its own: a table of sequence, run, variant, dilation_width and seconds.

    Only the first `frames` frames are timed; the first two steps are left out, since they load compiled code. The jobs
    of a sequence take turns at every frame, so that what else the machine does falls on all of them alike.
    To be called after `run`, whose folder it shares.
    """
    files = {name: folder / name / f"seconds-{frames}.csv" for name in sorted({job.sequence for job in jobs})}
    waiting = {name: [job for job in jobs if job.sequence == name] for name in files}
    waiting = {name: of_name for name, of_name in waiting.items() if not files[name].is_file()
               or not {job.name for job in of_name} <= set(pd.read_csv(files[name])["run"])}
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")(
        joblib.delayed(_time_jobs)(of_name, Sequence(kitti, name).subset(frames), labels, files[name], settings)
        for name, of_name in waiting.items())
    for _ in progress(work, "timing", total=len(waiting), unit="sequence"):
        pass
    return pd.concat([pd.read_csv(path, dtype={"sequence": str}) for path in files.values()], ignore_index=True)


def _time_jobs(jobs, sequence, labels, path, settings):
    cv2.setNumThreads(1)  # one thread makes times comparable
    scales = odometry.scales(sequence)
    variants, _ = _variants(jobs, sequence, labels, settings)
    runs = {job: odometry.Odometry(sequence.intrinsics, chosen) for job, (chosen, _) in variants.items()}
    seconds = dict.fromkeys(variants, 0.0)
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        for job, (_, masks) in variants.items():
            forget_edges()  # each run of its own would have to make them
            started = time.perf_counter()
            mask = None if masks is None else masks[index]
            mask_seconds = time.perf_counter() - started
            step = runs[job].step(frame, scales[index], mask)
            if index > 1:
                # Section 4.2 counts what happens from frame to frame and the making of the mask, not the prediction
                seconds[job] += mask_seconds + sum(step.seconds.values())
    table = pd.DataFrame([{"sequence": job.sequence, "run": job.name, "variant": job.variant,
                           "dilation_width": job.dilation_width, "seconds": value} for job, value in seconds.items()],
                         columns=["sequence", "run", "variant", "dilation_width", "seconds"])
    write_text(path, table.to_csv(index=False))


def _summarize(job, sequence, folder):
    frames = pd.read_csv(_result(folder, job), keep_default_na=False, na_values={"detected": "", "tracked": ""})
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = frames[[f"r{i}{j}" for i in range(3) for j in range(3)]].to_numpy().reshape(-1, 3, 3)
    poses[:, :3, 3] = frames[["x", "y", "z"]]
    return {
        "sequence": job.sequence, "run": job.name, "variant": job.variant, "dilation_width": job.dilation_width,
        "max_keypoints": job.max_keypoints, "min_distance": job.min_distance, "pose": job.pose,
        "repetition": job.repetition, "frames": len(frames),
        "rmse": metrics.rmse(poses, sequence.poses), "mae": metrics.mae(poses, sequence.poses),
        "mean_keypoints": frames["detected"].mean(),
        "flagged": int((~frames["flag"].isin(["", "stationary"])).sum()),
    }


def paths(summary, folder):
    """Estimated positions (n, 3) of each row of a summary, keyed by sequence and run."""
    return {(row.sequence, row.run): pd.read_csv(folder / row.sequence / f"{row.run}.csv")[["x", "y", "z"]].to_numpy()
            for row in summary.itertuples()}


def true_paths(kitti, names, frames=None):
    """True positions (n, 3) in metres of each sequence."""
    return {name: Sequence(kitti, name).subset(frames).poses[:, :3, 3] for name in names}
