"""Training and prediction give the same bits on any processor and number of cores."""

import hashlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import keras
import numpy as np
import pytest

from thesis_repro.segmentation import training
from thesis_repro.segmentation.unet import build_unet

# equal with and without AVX-512, and with the caches of an AMD and an Intel processor
RECORDED = "67eee48bed51"


def digest():
    """Return a digest of the weights after two epochs and of the predictions."""
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (6, 96, 96, 1), np.uint8)
    labels = random.integers(0, 35, (6, 12, 12), np.uint8).repeat(8, 1).repeat(8, 2)
    keras.utils.set_random_seed(0)
    model = build_unet((96, 96, 1), 35, 4)
    model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()))
    model.fit(
        training.Batches([(images, labels)], 3, 0).dataset(), epochs=2, shuffle=False, verbose=0
    )
    values = [*model.get_weights(), model.predict(images, verbose=0)]
    return hashlib.sha256(b"".join(value.tobytes() for value in values)).hexdigest()


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs two cores and a system that can restrict a process to one",
)
def test_one_core_and_all_give_the_same_bits():
    code = (
        "from thesis_repro import segmentation; import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
        "import test_same_bits; print(test_same_bits.digest())"
    )
    one_core = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent,
        check=True,
    )
    assert one_core.stdout.split()[-1] == digest()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="recorded on x86_64")
def test_every_x86_processor_gives_the_recorded_bits():
    assert digest()[:12] == RECORDED
