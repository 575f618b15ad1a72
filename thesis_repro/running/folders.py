"""What stands in a folder of results beside them: the record of their inputs, digests, and the log.

This module imports only the standard library, as `messages` does.
"""

from pathlib import Path

RECORD = "made-from.json"  # see `results.stage`
LOG = "log.txt"  # see `messages.logged`
DIGESTS = "digests.txt"  # of tables, see `results.write_table`


def holds_results(folder: Path) -> bool:
    """Return whether a folder is one of results: whether it has a record of their inputs."""
    return (folder / RECORD).exists()
