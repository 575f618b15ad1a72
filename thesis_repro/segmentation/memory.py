"""Memory for training: a check that a batch fits, and a setting of the C library for freed memory.

The system kills a process that runs out of memory without a message, so memory is checked before
the training starts. On a GPU, TensorFlow itself reports a batch that does not fit.
"""

import ctypes
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import tensorflow as tf

from thesis_repro.errors import InputError

FLOAT = 4  # bytes
# peak memory over the sum of all outputs; 1.5 to 1.9 were measured on U-Nets of 16 to 64 filters
GRADIENTS = 1.4
CGROUP = Path("/sys/fs/cgroup")  # a container's memory limit and use, which psutil does not read
# glibc's M_ARENA_MAX, M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD, and their values in `keep_freed`
MALLOC_OPTIONS = {-8: 1, -4: 0, -1: 2**31 - 1, -2: 2**28}


def keep_freed() -> None:
    """Make the C library keep freed memory for the next batch.

    On a CPU, TensorFlow allocates every tensor anew. By default glibc requests each large one from
    the system, which fills it with zeros; that takes half the time of a training step. Without
    glibc, this function does nothing.
    """
    with suppress(AttributeError, OSError, TypeError):  # macOS, Windows
        for option, value in MALLOC_OPTIONS.items():
            ctypes.CDLL(None).mallopt(option, value)


def available() -> int:
    """Return the bytes that this process can still allocate.

    The machine or the limit of its container decides.
    """
    free = psutil.virtual_memory().available
    with suppress(OSError, ValueError):  # no cgroup files, or "max", which means no limit
        limit, used = (int((CGROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        free = min(free, limit - used)
    return free


def needed(model: Any, batch_size: int) -> int:
    """Return the least bytes that a training step takes.

    They hold the outputs of all layers, and some of their gradients.
    """
    values = 0
    for layer in model.layers:
        values += math.prod(size for size in layer.output.shape[1:] if size)
    return int(GRADIENTS * batch_size * FLOAT * values)


def require(model: Any, batch_size: int) -> None:
    """Raise InputError if a training batch cannot fit into the available memory."""
    need, room = needed(model, batch_size), available()
    if need > room and not tf.config.list_physical_devices("GPU"):
        raise InputError(
            f"batch_size={batch_size}: takes at least {need / 2**30:.1f} GiB of memory and "
            f"{room / 2**30:.1f} GiB are free; lower the batch size"
        )
