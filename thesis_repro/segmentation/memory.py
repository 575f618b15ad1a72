"""Memory for training: whether a batch fits, asked beforehand, and how the C library treats freed memory.

The system kills a process that runs out of memory without a message, so the reason would stay unknown. TensorFlow
itself reports a batch that does not fit on a GPU.
"""

import ctypes
import math
from contextlib import suppress
from pathlib import Path

import psutil
import tensorflow as tf

from thesis_repro import InputError

FLOAT = 4  # bytes
GRADIENTS = 1.4  # training's peak over the sum of all outputs; 1.5 to 1.9 were measured on U-Nets of 16 to 64 filters
CGROUP = Path("/sys/fs/cgroup")  # where a container says its limit and its use, which psutil does not read
# glibc's M_ARENA_MAX, M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD, and what `keep_freed` sets them to
MALLOC_OPTIONS = {-8: 1, -4: 0, -1: 2**31 - 1, -2: 2**28}


def keep_freed():
    """Have the C library keep freed memory for the next batch instead of giving it back to the system.

    TensorFlow on a CPU allocates every tensor anew. By default glibc asks the system for each large one, which hands
    it over page by page, zeroed: half the time of a training step. Does nothing where there is no glibc.
    """
    with suppress(AttributeError, OSError, TypeError):  # another C library, or none (Windows)
        for option, value in MALLOC_OPTIONS.items():
            ctypes.CDLL(None).mallopt(option, value)


def available():
    """Bytes that this process can still take: those of the machine, or of the container where it has less."""
    free = psutil.virtual_memory().available
    with suppress(OSError, ValueError):  # another kind of system, or "max": no limit
        limit, used = (int((CGROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        free = min(free, limit - used)
    return free


def needed(model, batch_size):
    """Bytes that a training step takes at the least: every layer's output is kept, and the way back adds gradients."""
    values = sum(math.prod(size for size in layer.output.shape[1:] if size) for layer in model.layers)
    return int(GRADIENTS * batch_size * FLOAT * values)


def require(model, batch_size):
    """Raise InputError where a batch of the training cannot fit into the memory that is left."""
    need, room = needed(model, batch_size), available()
    if need > room and not tf.config.list_physical_devices("GPU"):
        raise InputError(f"batch_size={batch_size}: takes at least {need / 2**30:.1f} GiB, of which "
                         f"{room / 2**30:.1f} GiB are left; lower the batch size")
