"""What masks of one label map share: masks of several widths have the same edges."""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import numpy as np

_caches: list[Any] = []


def remembered(function: Callable) -> Callable:
    """Let a function of a label map remember its last results, arrays that nobody changes.

    They are found by the label map's bytes, so a changed label map has none.
    """

    @lru_cache(maxsize=8)
    def from_bytes(ids: bytes, shape: tuple[int, ...], *arguments: Any) -> Any:
        result = function(np.frombuffer(ids, np.uint8).reshape(shape), *arguments)
        result.setflags(write=False)
        return result

    @wraps(function)
    def from_map(label_map: np.ndarray, *arguments: Any) -> Any:
        return from_bytes(label_map.tobytes(), label_map.shape, *arguments)

    _caches.append(from_bytes)
    return from_map


def forget() -> None:
    """Clear what is remembered, so that the time to make a mask can be measured."""
    for cache in _caches:
        cache.cache_clear()
