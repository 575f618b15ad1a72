"""Whether a batch fits into memory, asked beforehand: a process that runs out of it is killed without a word."""

import math
from pathlib import Path

from thesis_repro import InputError

FLOAT = 4  # bytes
_CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
            ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))


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


def needed(model, batch_size, training):
    """Bytes that a batch takes at the least.

    Training keeps the output of every layer until the way back; prediction needs one layer's input and output.
    """
    sizes = {layer.name: _values(layer.output) for layer in model.layers}
    if training:
        return batch_size * FLOAT * sum(sizes.values())
    return batch_size * FLOAT * max(_values(layer.input) + sizes[layer.name] for layer in model.layers)


def _values(tensors):
    tensors = tensors if isinstance(tensors, list | tuple) else [tensors]
    return sum(math.prod(size for size in tensor.shape[1:] if size) for tensor in tensors)


def require(model, batch_size, training=False):
    """Raise InputError where a batch cannot fit into the memory that is left."""
    room, need = available(), needed(model, batch_size, training)
    if room is not None and need > room:
        height, width = model.input_shape[1:3]
        raise InputError(f"batch_size={batch_size}: no memory for a batch of {batch_size} images of {height}x{width}, "
                         f"which takes at least {need / 2**30:.1f} GiB of which {room / 2**30:.1f} GiB are left; "
                         "lower the batch size")
