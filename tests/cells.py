"""The cells of the notebooks in git."""

import json

from thesis.run_settings import ROOT

NOTEBOOKS = sorted(path.name for path in (ROOT / "notebooks").glob("*.ipynb"))


def named(number):
    """The name of the notebook of a number, such as "06"."""
    (name,) = (name for name in NOTEBOOKS if name.startswith(number))
    return name


def cells(name, kind):
    """{id: text} of the cells of one kind, "code" or "markdown"."""
    read = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    return {cell["id"]: "".join(cell["source"]) for cell in read if cell["cell_type"] == kind}


def code_of(name):
    """The code of a notebook."""
    return "\n".join(cells(name, "code").values())
