"""`make figures` on the smallest profile."""

import os
import re
import subprocess

from thesis_repro.running.settings import PREFIX, ROOT

FIGURES = [
    *(f"figure_2_{n:02d}" for n in range(1, 13)),
    *(f"figure_3_{n:02d}" for n in range(1, 7)),
    *(f"figure_4_{n:02d}" for n in range(1, 18)),
    "figure_a_01",
]
# the number of a notebook in a command that executes it, in the output of make
EXECUTED = re.compile(r"(?:nbconvert)[^\n]*? notebooks/(\d\d)_")


def make_figures(tmp_path, *options, root=ROOT, target="figures"):
    # MAKEFLAGS would pass the options of an outer make on to this one
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("MAKE", "MFLAGS", PREFIX))
    }
    folders = f"BUILD={tmp_path / 'build'}", f"FIGURES={tmp_path / 'figures'}"
    return subprocess.run(
        ["make", target, "PROFILE=smoke", *folders, "-o", ".venv/ready", *options],
        cwd=root,
        env=environment | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
