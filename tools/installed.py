"""Whether .venv still has the packages that the project calls itself: `make` asks before it starts.

A newer Python or another tool, such as `uv sync`, may have removed some.
"""

import re
import sys
from importlib import metadata
from pathlib import Path


def missing(pins):
    """Return the packages in the first part of environment.txt that are not installed."""
    called = re.findall(r"^([\w.-]+)==", pins.partition("# What those need")[0], re.MULTILINE)
    return [name for name in called if not any(metadata.distributions(name=name))]


if __name__ == "__main__":
    names = missing(Path(__file__).parent.with_name("environment.txt").read_text(encoding="utf-8"))
    sys.exit(f"missing: {', '.join(names)}" if names else 0)
