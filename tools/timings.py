"""Measure the times of a run anew: those that Figure 4.17, the budget and the audit show.

After `make figures`: `make timings`. After `make evidence KITTI=build/excerpts`: `make timings
KITTI=build/excerpts`. Then the same command as before draws them. Those in git are measured at each
release, on a quiet machine.
"""

import json
from functools import partial

from keypoint_study.sources import Source
from thesis import few_keypoints, timing
from thesis.run_settings import read_settings
from thesis_repro.data import kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import MaskSettings
from thesis_repro.running import program
from thesis_repro.running.files import needed


def main():
    """Measure the times that the figures of a finished run show, and write their tables."""
    settings = read_settings()
    if settings.kitti_is_embedded and not settings.figures_in_git:
        raise InputError("the times of the embedded world are those of the default run: no PROFILE")
    labels = needed(settings.build / "labels", "05_prediction")
    text = needed(settings.build / "masks.json", "06_keypoint_masks").read_text(encoding="utf-8")
    mask_settings = json.loads(text)
    width = mask_settings.pop("width")
    source = Source(labels, settings=MaskSettings(**mask_settings))
    sequences = [
        Sequence(settings.kitti, name).subset(settings.sizes.frames)
        for name in kitti.sequences(settings.kitti)
    ]
    timing.of_run(settings, sequences, source, width, anew=True)
    if not settings.kitti_is_embedded:
        steps = partial(few_keypoints.time_steps, sequences[0], labels)
        timing.times(settings, "few_keypoints", steps, anew=True)
    program.summary(f"times of {timing.processor()}: {timing.folder(settings)}")


if __name__ == "__main__":
    program.run_main(main)
