"""Semantic segmentation (appendix A.3 to A.7).

Augmentation, the U-Net, its training, label maps and their quality. The first import sets the
environment variables that TensorFlow and the other libraries read when they are imported.
"""

import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from thesis_repro.errors import InputError
from thesis_repro.running import messages

# Settings that give the same bits on x86 processors with AVX2, together with `exact.same_bits`.
ARITHMETIC = {
    # TensorFlow splits sums among its threads, so the rounding depends on their number. A fixed
    # number gives the same bits on any number of cores. More threads than cores cost little; fewer
    # would leave cores of large machines idle.
    "TF_NUM_INTRAOP_THREADS": "8",
}
if platform.machine() in ("x86_64", "AMD64"):
    ARITHMETIC |= {
        # By default TensorFlow chooses between two libraries of kernels by the processor.
        "TF_ENABLE_ONEDNN_OPTS": "1",
        # By default kernels and compiled code use the widest instructions of the processor. Nearly
        # all processors since 2015 have AVX2.
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "XLA_FLAGS": "--xla_cpu_max_isa=AVX2",
    }
OTHER_VARIABLES = {
    "TF_CPP_MIN_LOG_LEVEL": "3",  # errors of TensorFlow are Python exceptions as well
    "TF_FORCE_GPU_ALLOW_GROWTH": "true",  # do not take all memory of a GPU at the start
    "SM_FRAMEWORK": "tf.keras",  # of segmentation-models
    "NO_ALBUMENTATIONS_UPDATE": "1",  # the search for a newer release needs a network
}


def _set_variables() -> None:
    """Set the variables that the libraries read at their import. Values of the user are kept."""
    variables = dict(OTHER_VARIABLES)
    if "tensorflow" not in sys.modules:  # otherwise too late; the record of results lacks them
        variables |= ARITHMETIC
    for name, value in variables.items():
        os.environ.setdefault(name, value)
    os.environ["KERAS_BACKEND"] = "tensorflow"  # the package calls TensorFlow itself
    for name in ("KERAS_MAX_EPOCHS", "KERAS_MAX_STEPS_PER_EPOCH"):  # end a training early, unsaid
        os.environ.pop(name, None)


_set_variables()
GPUS = "/dev/nvidiactl", "/dev/dxg"  # device files of NVIDIA's driver and of WSL 2


def arithmetic() -> dict[str, str | None]:
    """Return the settings that decide how TensorFlow rounds, for the record of results."""
    return {name: os.environ.get(name) for name in ARITHMETIC}


@contextmanager
def quietly() -> Iterator[None]:
    """Hide the messages that TensorFlow's C++ code prints while it loads, whatever its log level.

    Errors are raised. The message that there is no GPU is hidden too.
    Raises InputError under python -OO, which one of the libraries cannot be imported with.
    """
    if sys.flags.optimize > 1:
        raise InputError("python -OO: the segmentation's libraries need docstrings; use python -O")
    with messages.quiet():
        yield
        if not any(map(os.path.exists, GPUS)):
            sys.modules["tensorflow"].config.list_physical_devices()
