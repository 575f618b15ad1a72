"""Which Python to install with, and whether .venv is still whole: what `make setup` asks.

Any Python can run it. TensorFlow decides: it has files for Python 3.11 to 3.13, on Linux and on
Macs with Apple's processors. With --search, another Python is looked for if this one does not fit:
on the PATH, and then by uv, which may fetch one. --check names what .venv lacks: a newer Python or
another tool, such as `uv sync`, may have removed it.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile

PINS = os.path.join(os.path.dirname(os.path.abspath(__file__)), os.pardir, "environment.txt")
FITS = "import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))"


def reason(version, system, machine):
    """Return what stands in the way, or an empty text. version: (major, minor)."""
    if system == "Windows":
        return "Windows: use WSL (Ubuntu), or the container (Dockerfile)"
    if system == "Darwin" and machine == "x86_64":
        return "a Mac with an Intel processor: TensorFlow 2.21 has no file for it; use the container (Dockerfile)"
    if not (3, 11) <= version < (3, 14):
        return (
            "Python 3.11, 3.12 or 3.13 is needed; name one, such as make figures PYTHON=python3.12"
        )
    return ""


def found():
    """Return the path of another Python that fits; None if there is none."""
    for name in ("python3.13", "python3.12", "python3.11"):
        for folder in os.get_exec_path():
            path = shutil.which(name, path=folder)
            if path and output([path, "-c", FITS]) is not None:
                return path
    with tempfile.TemporaryDirectory() as folder:
        uv = shutil.which("uv")
        if not uv:  # it installs under any Python
            pin = re.search("^uv==[0-9.]+", pins(), re.MULTILINE).group()
            output([sys.executable, "-m", "pip", "install", "--target", folder, pin])
            uv = os.path.join(folder, "bin", "uv")
        find = [uv, "python", "find", "--no-project", "3.13"]
        if not output(find):
            output([uv, "python", "install", "3.13"])
        return output(find)


def pins():
    """Return the text of environment.txt."""
    with open(PINS) as file:
        return file.read()


def output(command):
    """Return what a command prints, or None if it fails."""
    try:
        printed = subprocess.check_output(command, stderr=subprocess.DEVNULL)
    except (OSError, subprocess.CalledProcessError):
        return None
    return printed.decode().strip()


def missing(pinned):
    """Return the packages in the first part of a text of pins that are not installed."""
    from importlib import metadata  # not in every Python

    called = re.findall(r"^([\w.-]+)==", pinned.partition("# What those need")[0], re.MULTILINE)
    return [name for name in called if not any(metadata.distributions(name=name))]


def main(options):
    """Print the path of the Python to install with, or end with the reason why there is none."""
    if "--check" in options:
        names = missing(pins())
        sys.exit("missing: " + ", ".join(names) if names else 0)
    version, machine = sys.version_info[:2], (platform.system(), platform.machine())
    said, path = reason(version, *machine), sys.executable
    if said:
        another_would_do = "--search" in options and not reason((3, 13), *machine)
        path = found() if another_would_do else None
        if not path:
            sys.exit("error: " + said)
        sys.stderr.write("python3 is {}.{}, so {} is taken\n".format(*version, path))
    print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
