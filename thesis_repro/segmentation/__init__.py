"""Semantic segmentation (appendix A.3 to A.7): augmentation, the U-Net, its training, label
maps and their quality.
"""

import os
import sys
from contextlib import contextmanager

# Variables that libraries read when they are imported, or at TensorFlow's first operation. Values
# of the user are kept.
for _name, _value in {
    # TensorFlow splits sums among its threads, so the rounding depends on their number. A fixed
    # number gives the same bits on any number of cores. More threads than cores cost little; fewer
    # would leave cores of large machines idle.
    "TF_NUM_INTRAOP_THREADS": "8",
    "TF_CPP_MIN_LOG_LEVEL": "3",  # errors of TensorFlow are Python exceptions as well
    "TF_FORCE_GPU_ALLOW_GROWTH": "true",  # do not take all memory of a GPU at the start
    "SM_FRAMEWORK": "tf.keras",  # of segmentation-models
    "NO_ALBUMENTATIONS_UPDATE": "1",  # the search for a newer release needs a network
}.items():
    os.environ.setdefault(_name, _value)

os.environ["KERAS_BACKEND"] = "tensorflow"  # the package calls TensorFlow itself
GPUS = "/dev/nvidiactl", "/dev/dxg"  # device files of NVIDIA's driver and of WSL 2


@contextmanager
def quietly():
    """Hide the messages that TensorFlow's C++ code prints while it loads, whatever its log level;
    errors are raised.

    The message that there is no GPU is hidden too.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    originals = os.dup(1), os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(null, stream)
        yield
        if not any(map(os.path.exists, GPUS)):
            sys.modules["tensorflow"].config.list_physical_devices()
    finally:
        sys.stdout.flush()
        for stream, original in enumerate(originals, 1):
            os.dup2(original, stream)
        for descriptor in (*originals, null):
            os.close(descriptor)
