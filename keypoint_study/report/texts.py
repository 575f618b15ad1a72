"""Texts made from the folder templates, and numbers and names as texts."""

import os
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from keypoint_study.ratios import side_of_one
from thesis_repro.errors import one_line

# behind an interval, by the side of 1 on which it lies
MARKS = {-1: " ↓", 0: "", 1: " ↑"}
LOADER = FileSystemLoader(Path(__file__).parent / "templates")  # others may add their folders
TEMPLATES = Environment(
    loader=LOADER,
    autoescape=lambda name: ".html" in (name or ""),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """Return the text of a template in the folder templates.

    Repeated empty lines in Markdown become one.
    """
    text = TEMPLATES.get_template(template).render(values).strip() + "\n"
    if ".md" in template:
        text = re.sub(r"\n{3,}", "\n\n", text)
    return text


def number(value: float) -> str:
    """Return a ratio as text, with two digits after the point."""
    return f"{value:z.2f}"


def short(row: Mapping[str, Any] | pd.Series) -> str:
    """Return "1.09 (0.98-1.32)" for a row with ratio, low and high.

    An arrow behind it says that the whole interval is below or above 1, which two digits may not
    show: "1.02 (1.00-1.08) ↑". Without an interval (low is missing) it is only the
    ratio.
    """
    typical = number(row["ratio"])
    if pd.isna(row["low"]):
        return typical
    mark = MARKS[side_of_one(row["low"], row["high"])]
    return f"{typical} ({number(row['low'])}-{number(row['high'])}){mark}"


def in_markdown(text: object) -> str:
    """Return a name as one line that Markdown shows as it is.

    It then makes no link, picture, HTML tag, emphasis or cell of a table.
    """
    special = r"[\\`*<>|&~]|\](?=[(\[])|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, r"\\\g<0>", one_line(text))


def in_url(name: str) -> str:
    """Return the name of a file for a link, whatever its bytes."""
    return quote(os.fsencode(name))


TEMPLATES.filters |= {
    "in_markdown": in_markdown,
    "in_shell": shlex.quote,
    "one_line": one_line,
    "urlencode": in_url,
}
