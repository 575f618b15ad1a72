"""Print the Python to install with, or say in one line why the pinned packages cannot be installed.

Any Python can run it. TensorFlow decides: it has files for Python 3.11 to 3.13, on Linux and on
Macs with Apple's processors. With --search, another Python is looked for if this one does not fit:
on the PATH, and then by uv, which may fetch one.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile


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
    """Return the path of a Python that fits, other than this one, or None."""
    for name in ("python3.13", "python3.12", "python3.11"):
        for folder in os.get_exec_path():
            path = shutil.which(name, path=folder)
            if path and _runs(path):
                return path
    if shutil.which("uv"):
        return _by_uv("uv")
    with tempfile.TemporaryDirectory() as folder:  # uv installs under any Python
        with open("environment.txt") as pins:
            uv = re.search("^uv==[0-9.]+", pins.read(), re.MULTILINE).group()
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", folder, uv]
        if _output(pip) is None:
            return None
        return _by_uv(os.path.join(folder, "bin", "uv"))


def _by_uv(uv):
    """Return the path of the Python 3.13 that uv has, or fetches; None if there is none."""
    find = [uv, "python", "find", "--no-project", "--quiet", "3.13"]
    path = _output(find)
    if not path and _output([uv, "python", "install", "--quiet", "3.13"]) is not None:
        path = _output(find)
    return path if path and _runs(path) else None


def _runs(python):
    """Return whether a Python starts, can make an environment, and fits."""
    code = "import ensurepip, sys, venv; print((3, 11) <= sys.version_info[:2] < (3, 14))"
    return _output([python, "-c", code]) == "True"


def _output(command):
    """Return what a command prints, or None if it fails."""
    try:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.decode().strip()


def main(search):
    """Print the path of the Python to install with. It ends with the reason if there is none."""
    version, *machine = sys.version_info[:2], platform.system(), platform.machine()
    said = reason(version, *machine)
    path = None if said else sys.executable
    if said and search and not reason((3, 13), *machine):  # another version would do
        path = found()
        if path:
            sys.stderr.write("python3 is {}.{}, so {} is taken\n".format(*version, path))
    if not path:
        sys.exit("error: " + said)
    print(path)


if __name__ == "__main__":
    main("--search" in sys.argv)
