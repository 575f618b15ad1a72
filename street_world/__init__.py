"""The embedded world: rendered street drives with exact poses and label maps.

Its files have the layouts of the real data.
"""

from street_world.dataset import write

__all__ = ["write"]
