"""Memory for batches: whether a batch fits, asked beforehand, and how the C library treats freed memory.

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
# limit and use of a container, which psutil does not read: control groups of version 2 and of version 1
CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
           ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))
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
    """Bytes that this process can still take: the least of the machine's, the container's and the process's own."""
    limits = [psutil.virtual_memory().available]
    for limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # another kind of system, or "max": no limit
            limits.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    with suppress(AttributeError):  # psutil knows the process's own limit on Linux alone
        limit, _ = psutil.Process().rlimit(psutil.RLIMIT_AS)
        if limit != psutil.RLIM_INFINITY:
            limits.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(limits))


def needed(model, batch_size, training):
    """Bytes that a batch takes at the least.

    Training keeps the output of every layer until the backward pass, which adds gradients. Prediction needs the input
    and the output of one layer at a time.
    """
    if training:
        return int(GRADIENTS * batch_size * FLOAT * sum(_values(layer.output) for layer in model.layers))
    return batch_size * FLOAT * max(_values(layer.input) + _values(layer.output) for layer in model.layers)


def _values(tensors):
    return sum(math.prod(size for size in tensor.shape[1:] if size) for tensor in tf.nest.flatten(tensors))


def require(model, batch_size, training=False):
    """Raise InputError where a batch cannot fit into the memory that is left."""
    need, room = needed(model, batch_size, training), available()
    if need > room and not tf.config.list_physical_devices("GPU"):
        raise InputError(f"batch_size={batch_size}: takes at least {need / 2**30:.1f} GiB, of which "
                         f"{room / 2**30:.1f} GiB are left; lower the batch size")
