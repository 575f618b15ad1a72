"""Semantic segmentation (appendix A.3 to A.7).

Augmentation, the U-Net, its training, label maps and their quality. The first import sets the
environment variables that TensorFlow and the other libraries read when they are imported.
"""

import io
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

from thesis_repro.running import program

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
    "NO_ALBUMENTATIONS_UPDATE": "1",  # the search for a newer release needs a network
}


# Values of the user are kept. After TensorFlow's import, ARITHMETIC would come too late, so it is
# left out, and the record of results shows that.
_variables = dict(OTHER_VARIABLES)
if "tensorflow" not in sys.modules:
    _variables |= ARITHMETIC
for _name, _value in _variables.items():
    os.environ.setdefault(_name, _value)
os.environ["KERAS_BACKEND"] = "tensorflow"  # the package calls TensorFlow itself
os.environ["TF_USE_LEGACY_KERAS"] = "0"  # and Keras 3
os.environ["SM_FRAMEWORK"] = "tf.keras"  # the only one of segmentation-models that works with it

# code that makes label maps and trainings
CODE = ("thesis_repro/segmentation", "thesis_repro/data", "thesis_repro/running/files.py")
GPUS = "/dev/nvidiactl", "/dev/dxg"  # device files of NVIDIA's driver and of WSL 2


def arithmetic() -> dict[str, str | None]:
    """Return the settings that decide how TensorFlow rounds, for the record of results."""
    return {name: os.environ.get(name) for name in ARITHMETIC}


@contextmanager
def quietly() -> Iterator[None]:
    """Hide what libraries print while they load: TensorFlow's C++ code, segmentation-models.

    Errors are raised. The message that there is no GPU is hidden too.
    """
    with program.quiet(), redirect_stdout(io.StringIO()):
        yield
        if not any(map(os.path.exists, GPUS)):
            sys.modules["tensorflow"].config.list_physical_devices()
