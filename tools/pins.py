"""Resolve environment.txt anew for Python 3.11 to 3.13 and every machine.

Its first part names the packages that the project calls itself: change a version there. The second
part, what those need, is rewritten. Versions that still fit stay.
"""

import subprocess
import tempfile
from pathlib import Path

from thesis.run_settings import ROOT
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import write_text

PINS = ROOT / "environment.txt"
HEADING = "# What those need:\n"
UV = [".venv/bin/uv", "pip", "compile", "--quiet", "--universal", "--python-version", "3.11"]
OPTIONS = ["--fork-strategy", "fewest", "--no-header", "--no-annotate"]
# jsonschema does without it; its import takes a second in each notebook that is executed
LEFT_OUT = ("rfc3987-syntax", "lark")


def main() -> None:
    """Rewrite the second part of environment.txt."""
    direct, heading, _ = PINS.read_text(encoding="utf-8").partition(HEADING)
    with tempfile.TemporaryDirectory() as folder:
        wanted, resolved = Path(folder, "direct.in"), Path(folder, "environment.txt")
        wanted.write_text(direct, encoding="utf-8")
        resolved.write_text(PINS.read_text(encoding="utf-8"), encoding="utf-8")
        if subprocess.run([*UV, *OPTIONS, wanted, "-o", resolved], cwd=ROOT).returncode:
            raise InputError(f"{PINS}: uv cannot resolve its first part; see above, and change it")
        pins = resolved.read_text(encoding="utf-8").splitlines(keepends=True)
    called = {line.partition("==")[0] for line in direct.splitlines() if "==" in line}
    needed = [line for line in pins if line.partition("==")[0] not in {*called, *LEFT_OUT}]
    write_text(PINS, direct + heading + "\n" + "".join(needed))


if __name__ == "__main__":
    program.run_main(main)
