"""The embedded world: rendered street drives with exact poses and label maps.

Its files have the layouts of the real data.
"""

from typing import Any

from street_world.dataset import write

__all__ = ["SIZES", "write"]


def _sizes(
    sequences: int, frames: int, train_images: int, validation_images: int
) -> dict[str, Any]:
    """Return arguments of `write`. frames: of each sequence."""
    return {
        "sequences": tuple(f"{number:02d}" for number in range(sequences)),
        "frames": frames,
        "train_images": train_images,
        "validation_images": validation_images,
    }


SIZES = {
    "smoke": _sizes(2, 12, 12, 4),
    "lab": _sizes(6, 25, 60, 12),
    # A street depends on its drive's length. With 24 frames, steps of drive 05 fail even with all
    # keypoints.
    "demo": _sizes(11, 25, 100, 20),
    "thesis": _sizes(11, 300, 2975, 500),
}
