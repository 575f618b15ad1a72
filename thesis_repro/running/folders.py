"""What stands in a folder of results beside them: the record of their inputs, and the log.

This module imports only the standard library, as `console` does.
"""

from pathlib import Path

RECORD = "made-from.json"  # see `results.stage`
LOG = "log.txt"  # see `console.logged`


def holds_results(folder: Path) -> bool:
    """Return whether a folder is one of results: whether it has a record of their inputs."""
    return (folder / RECORD).exists()
