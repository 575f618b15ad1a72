"""The segmentation (appendix A.3 to A.7): augmentation, the U-Net, its training, label maps and their quality."""

import os
import sys
from contextlib import contextmanager

# TensorFlow splits an operation among its threads, and sums of pieces round differently for another number of pieces.
# With a number of its own instead of the machine's, any number of cores gives the same bits. It is read once, when the
# first operation runs. More threads than cores cost little; fewer would leave cores of large machines idle.
os.environ.setdefault("TF_NUM_INTRAOP_THREADS", "8")

GPUS = "/dev/nvidiactl", "/dev/dxg"  # with NVIDIA's driver, and with that of WSL 2


@contextmanager
def quietly():
    """Hide what TensorFlow prints while it loads; its C++ code prints that past every setting.

    It also complains where there is no GPU, which is hidden too. Errors are raised as usual.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    originals = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        yield
        if not any(map(os.path.exists, GPUS)):
            sys.modules["tensorflow"].config.list_physical_devices()
    finally:
        sys.stdout.flush()
        for stream, original in enumerate(originals, 1):
            os.dup2(original, stream)
        for descriptor in (*originals, nowhere):
            os.close(descriptor)
