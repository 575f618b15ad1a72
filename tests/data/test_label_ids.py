"""Tables of ids and colours that cannot be meant."""

import pytest

from thesis_repro.data import label_ids
from thesis_repro.errors import InputError


@pytest.mark.parametrize(
    "lines, line",
    [
        ("#464646ff,building", 1),  # with alpha
        ("#464646,building\n#80408080,road", 2),
        ("#444,building", 1),
        ("#4646_6,building", 1),
        ("7,road\n11,building\n7,sky", 3),
        ("#464646,road\n#464646,building", 2),
        ("7,road\n#464646,building", 2),
        ("65536,road", 1),
        ("-2,road", 1),
    ],
)
def test_a_line_that_cannot_be_meant_is_named(tmp_path, lines, line):
    path = tmp_path / "table.csv"
    path.write_text(lines)
    with pytest.raises(InputError, match=f"table.csv, line {line}: "):
        label_ids.read_table(path)


def test_colours_and_ids(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("color,name\n#464646,building\n#80408A,road\n")
    assert label_ids.read_table(path) == (True, {0x464646: 11, 0x80408A: 7})
    path.write_text("-1,unlabeled\n65535,sky\n")  # Cityscapes' own list has -1
    assert label_ids.read_table(path) == (False, {-1: 0, 65535: 23})
