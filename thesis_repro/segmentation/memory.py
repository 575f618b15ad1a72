"""Memory for batches: whether a batch fits, asked beforehand, and how the C library treats freed memory.

The system kills a process that runs out of memory without a message, so the reason would stay unknown.
"""

import ctypes
import math
import shutil
import subprocess
import sys
from pathlib import Path

import psutil

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
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return
    for option, value in MALLOC_OPTIONS.items():
        mallopt(ctypes.c_int(option), ctypes.c_int(value))


def available():
    """Bytes that this process can still take: the least of the machine's, the container's and the process's own."""
    limits = [psutil.virtual_memory().available]
    for limit, used in CGROUPS:
        try:
            limits.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # another kind of system, or "max": no limit
            pass
    process = psutil.Process()
    if hasattr(process, "rlimit"):  # Linux
        limit, _ = process.rlimit(psutil.RLIMIT_AS)
        if limit != psutil.RLIM_INFINITY:
            limits.append(limit - process.memory_info().vms)
    return max(0, min(limits))


def on_gpu():
    """Bytes of memory of the smallest GPU; None where TensorFlow uses none or its size is unknown.

    All of it counts, because what TensorFlow already holds serves the next batch again.
    """
    import tensorflow as tf

    tool = shutil.which("nvidia-smi")
    if tool is None or not tf.config.list_physical_devices("GPU"):
        return None
    answer = subprocess.run([tool, "--query-gpu=memory.total", "--format=csv,noheader,nounits"], capture_output=True,
                            text=True)
    sizes = [int(word) for word in answer.stdout.split() if word.isdigit()]
    return min(sizes) * 2**20 if sizes else None


def needed(model, batch_size, training):
    """Bytes that a batch takes at the least.

    Training keeps the output of every layer until the backward pass, which adds gradients. Prediction needs the input
    and the output of one layer at a time.
    """
    sizes = {layer.name: _values(layer.output) for layer in model.layers}
    if training:
        return int(GRADIENTS * batch_size * FLOAT * sum(sizes.values()))
    return batch_size * FLOAT * max(_values(layer.input) + sizes[layer.name] for layer in model.layers)


def _values(tensors):
    tensors = tensors if isinstance(tensors, list | tuple) else [tensors]
    return sum(math.prod(size for size in tensor.shape[1:] if size) for tensor in tensors)


def require(model, batch_size, training=False):
    """Raise InputError where a batch cannot fit into the memory that is left, or into that of the GPU."""
    gpu, need = on_gpu(), needed(model, batch_size, training)
    room, where = (available(), "left") if gpu is None else (gpu, "on the GPU")
    if need > room:
        height, width = model.input_shape[1:3]
        raise InputError(f"batch_size={batch_size}: no memory for a batch of {batch_size} images of {height}x{width}, "
                         f"which takes at least {need / 2**30:.1f} GiB of which {room / 2**30:.1f} GiB are {where}; "
                         "lower the batch size")
