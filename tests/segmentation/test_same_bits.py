"""Training and prediction give the same bits on any number of cores."""

import os
import subprocess
import sys

import pytest

TRAIN = """
import hashlib, os, sys
os.sched_setaffinity(0, set(map(int, sys.argv[1].split(","))))
import keras, numpy as np
from thesis_repro.segmentation import prediction, training
from thesis_repro.segmentation.unet import build_unet

random = np.random.default_rng(0)
images = random.integers(0, 256, (6, 96, 96, 1), np.uint8)
labels = random.integers(0, 35, (6, 12, 12), np.uint8).repeat(8, 1).repeat(8, 2)
keras.utils.set_random_seed(0)
model = build_unet((96, 96, 1), 35, 4)
model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()))
model.fit(training.Batches([(images, labels)], 3, 0).dataset(), epochs=2, shuffle=False, verbose=0)
values = [*model.get_weights(), model.predict(images, verbose=0)]
print(hashlib.sha256(b"".join(value.tobytes() for value in values)).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
                    reason="two cores are needed, and a system that can take one away")
def test_one_core_and_two_give_the_same_bits():
    first, second, *_ = sorted(os.sched_getaffinity(0))
    runs = [subprocess.Popen([sys.executable, "-c", TRAIN, cores], stdout=subprocess.PIPE, text=True)
            for cores in (f"{first},{second}", f"{first}")]
    both_cores, one_core = (run.communicate()[0].split() for run in runs)
    assert both_cores[-1] == one_core[-1] and len(one_core[-1]) == 64
