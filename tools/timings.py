"""Measure the times in git anew: those that Figure 4.17, the budget and the audit show.

After `make figures`: `make timings`. After `make evidence KITTI=build/excerpts`: `make timings
KITTI=build/excerpts`. Then the same command as before draws them. Run it on a quiet machine, at
each release.
"""

import json

from keypoint_study.sources import Source
from thesis import artefacts, few_keypoints, timing
from thesis.settings import read_settings
from thesis_repro.data import kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import MaskSettings
from thesis_repro.running import program
from thesis_repro.running.files import needed, write_text


def main():
    """Write the tables of times. Raises InputError for a run whose figures are not those in git."""
    settings = read_settings()
    folder = timing.folder_in_git(settings)
    if folder is None:
        raise InputError("timings: only those of the default run and of the evidence are in git")
    labels = needed(settings.build / "labels", "05_prediction")
    mask_settings = json.loads(
        needed(settings.build / "masks.json", "06_keypoint_masks").read_text()
    )
    width = mask_settings.pop("width")
    source = Source(labels, settings=MaskSettings(**mask_settings))
    sequences = [
        Sequence(settings.kitti, name).subset(settings.sizes.frames)
        for name in kitti.sequences(settings.kitti)
    ]
    shortened = [sequence.subset(settings.sizes.timed_frames) for sequence in sequences]
    widths = sorted({*settings.sizes.widths, width})
    tables = {
        "seconds": timing.seconds_of_widths(shortened, source, widths),
        "budget": timing.time_stages(sequences[0], artefacts.used_model(), width),
    }
    if not settings.kitti_is_embedded:
        again = settings.build / "timings" / "few_keypoints"
        (again / sequences[0].name / "milliseconds.csv").unlink(missing_ok=True)
        tables["few_keypoints"] = few_keypoints.time_steps(sequences[0], labels, again)
    for name, table in tables.items():
        measured = table.assign(**timing.circumstances(settings))
        text = measured.to_csv(index=False, lineterminator="\n", float_format="%.6g")
        write_text(folder / f"{name}.csv", text)
    program.summary(f"times of {timing.processor()}: {folder}")


if __name__ == "__main__":
    program.run_main(main)
