"""Memory for batches: whether one fits, asked beforehand, and how the system's allocator is to treat them.

A process that runs out of memory is killed without a word, so nobody would know what to change.
"""

import ctypes
import math
import shutil
import subprocess
import sys
from pathlib import Path

from thesis_repro import InputError

FLOAT = 4  # bytes
GRADIENTS = 1.4  # training's peak over the sum of all outputs; 1.5 to 1.9 were measured on U-Nets of 16 to 64 filters
_CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
            ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))

# glibc's names for what `keep_freed` sets, and the values
_MALLOC_OPTIONS = {"M_ARENA_MAX": (-8, 1), "M_MMAP_MAX": (-4, 0), "M_TRIM_THRESHOLD": (-1, 2**31 - 1),
                   "M_TOP_PAD": (-2, 2**28)}


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
    for option, value in _MALLOC_OPTIONS.values():
        mallopt(ctypes.c_int(option), ctypes.c_int(value))


def available():
    """Bytes that this process can still take: the least of the machine's, the container's and the process's own.

    None where the system does not tell (not Linux).
    """
    try:
        meminfo = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        rooms = [int(meminfo["MemAvailable"].split()[0]) * 1024]
    except (OSError, KeyError):
        return None
    for limit, used in _CGROUPS:
        try:
            rooms.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # another kind of system, or "max": no limit
            pass
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        rooms.append(limit - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize())
    return max(0, min(rooms))


def on_gpu():
    """Bytes of memory of the smallest GPU, where TensorFlow uses one; None where it does not or nobody tells.

    All of it, because what TensorFlow already holds serves the next batch again.
    """
    import tensorflow as tf

    tool = shutil.which("nvidia-smi")
    if tool is None or not tf.config.list_physical_devices("GPU"):
        return None
    told = subprocess.run([tool, "--query-gpu=memory.total", "--format=csv,noheader,nounits"], capture_output=True,
                          text=True)
    sizes = [int(word) for word in told.stdout.split() if word.isdigit()]
    return min(sizes) * 2**20 if sizes else None


def needed(model, batch_size, training):
    """Bytes that a batch takes at the least.

    Training keeps the output of every layer until the way back, where gradients come on top; prediction needs one
    layer's input and output.
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
    room = available() if gpu is None else gpu
    if room is not None and need > room:
        height, width = model.input_shape[1:3]
        where = "left" if gpu is None else "on the GPU"
        raise InputError(f"batch_size={batch_size}: no memory for a batch of {batch_size} images of {height}x{width}, "
                         f"which takes at least {need / 2**30:.1f} GiB of which {room / 2**30:.1f} GiB are {where}; "
                         "lower the batch size")
