"""Tables of ids: a file NAME.csv in this folder is what --ids NAME reads through."""

from pathlib import Path

LABEL_IDS = "labels"  # Cityscapes' own, which need no table


def names() -> list[str]:
    """Names that --ids knows."""
    return [LABEL_IDS, *sorted(path.stem for path in Path(__file__).parent.glob("*.csv"))]


def file(ids: str | Path) -> Path:
    """File of the table with a name; another one is that of a user's file."""
    if str(ids) in names():
        return Path(__file__).with_name(f"{ids}.csv")
    return Path(ids)
