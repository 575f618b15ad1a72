"""What masks of one label map share: masks of several widths have the same edges."""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import numpy as np


def remembered(function: Callable) -> Any:
    """Let a function of a label map remember its last results, arrays that nobody changes.

    They are found by the label map's bytes, so a changed label map has none. Its `forget()` clears
    them.
    """

    @lru_cache(maxsize=8)
    def from_bytes(ids: bytes, shape: tuple[int, ...], *arguments: Any) -> Any:
        result = function(np.frombuffer(ids, np.uint8).reshape(shape), *arguments)
        result.setflags(write=False)
        return result

    @wraps(function)
    def from_map(label_map: np.ndarray, *arguments: Any) -> Any:
        return from_bytes(label_map.tobytes(), label_map.shape, *arguments)

    from_map.forget = from_bytes.cache_clear  # type: ignore[attr-defined]
    return from_map
