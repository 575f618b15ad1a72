"""The parts that pages are put together from: documents, tables, Markdown, sizes of drawings, links between files."""

import csv
import os
import re
from html import escape
from pathlib import Path
from urllib.parse import quote

STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")


def document(title, style, body):
    """A whole HTML document that loads nothing from elsewhere."""
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n")


def link(path, folder):
    """A relative link from a page in the folder to the file."""
    return quote(os.path.relpath(path, folder))


def svg_size(path):
    """Width and height in pixels as an SVG file says, so that a page keeps its place while it loads; None if silent."""
    with open(path, encoding="utf-8") as file:
        head = file.read(2000)
    size = re.search(r'<svg[^>]*?width="([\d.]+)pt"[^>]*?height="([\d.]+)pt"', head) or \
        re.search(r'<svg[^>]*?height="([\d.]+)pt"[^>]*?width="([\d.]+)pt"', head)
    if not size:
        return None
    return tuple(round(float(points) * 4 / 3) for points in size.groups())


def markdown(text):
    """Markdown as HTML, its headings below those of a page; HTML in it is shown as text."""
    import mistune  # comes with nbconvert; slow to import

    html = mistune.create_markdown(escape=True, plugins=["table"])(text)
    return re.sub(r"<(/?)h([1-6])", lambda match: f"<{match[1]}h{min(6, int(match[2]) + 3)}", html)


NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")
RANGE = re.compile(rf"{NUMBER.pattern} to {NUMBER.pattern}")


def table(header, rows):
    """Lines of a CSV file as an HTML table: numbers to the right, whole ones without the point of missing values."""
    columns = list(zip(*rows, strict=True)) or [()] * len(header)
    right = [_is_numeric(name, column) for name, column in zip(header, columns, strict=True)]
    shown = [[_shown(value, name, column, row) if number else escape(value)
              for value, name, column, number in zip(row, header, columns, right, strict=True)] for row in rows]
    marks = [' class="number"' if number else "" for number in right]
    names = [f'<th scope="col"{mark}>{escape(name)}</th>' for name, mark in zip(header, marks, strict=True)]
    html = ["<table>", f"<thead><tr>{''.join(names)}</tr></thead>", "<tbody>"]
    html += ["<tr>" + "".join(f"<td{mark}>{value}</td>" for value, mark in zip(row, marks, strict=True)) + "</tr>"
              for row in shown]
    return "\n".join([*html, "</tbody>", "</table>"])


def _is_numeric(name, column):
    filled = [value for value in column if value]
    return (name != "sequence" and bool(filled)
            and all(NUMBER.fullmatch(value) or RANGE.fullmatch(value) for value in filled))


def _shown(value, name, column, row):
    numbers = [cell for cell in row if NUMBER.fullmatch(cell)]
    if NUMBER.fullmatch(value):
        counts = len(numbers) > 1 and all(_is_whole(cell) for cell in numbers)  # such as a row that counts sequences
        if counts or all(_is_whole(cell) for cell in column if cell):
            value = value.split(".")[0]
        elif "%" in name:
            digits = max(len(cell.partition(".")[2]) for cell in column)
            value = f"{float(value):.{digits}f}"
    return escape(value).replace("-", "−")


def _is_whole(value):
    return bool(NUMBER.fullmatch(value)) and float(value).is_integer()


def lines(path):
    """The lines of a CSV file, header first; none where there is no file."""
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.reader(file))
