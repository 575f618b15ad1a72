"""Say in one line why the pinned packages cannot be installed here, before anything is.

Any Python can run it. TensorFlow decides: it has files for Python 3.11 to 3.13, on Linux and on
Macs with Apple's processors.
"""

import platform
import sys


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


if __name__ == "__main__":
    found = reason(sys.version_info[:2], platform.system(), platform.machine())
    sys.exit("error: " + found if found else 0)
