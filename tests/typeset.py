"""LaTeX, for tests that run where pdflatex is installed."""

import re
import shutil
import subprocess

PDFLATEX = shutil.which("pdflatex")
MOST = 3  # points by which a line may be too wide


def assert_fits(texts, columns, folder):
    """Typeset tables, {name: LaTeX}, in one document. No line or page may be too full."""
    document = (
        rf"\documentclass[{columns}]{{article}}\usepackage{{booktabs,graphicx}}\begin{{document}}"
    )
    for name, text in texts.items():
        (folder / f"{name}.tex").write_text(text)
        document += f"\nText.\n\n\\input{{{name}}}\n"
    (folder / "document.tex").write_text(document + "\\end{document}\n")
    command = [PDFLATEX, "-interaction=nonstopmode", "-halt-on-error", "document.tex"]
    typeset = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert typeset.returncode == 0, typeset.stdout[-2000:]
    too_full = re.findall(r"Overfull \\[hv]box \(([\d.]+)pt", typeset.stdout)
    assert [points for points in too_full if float(points) > MOST] == []
