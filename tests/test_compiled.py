import os

from thesis_repro import compiled


def test_what_was_compiled_before_a_neighbour_changed_is_deleted_whatever_the_dates_are(tmp_path):
    room, neighbour = tmp_path / "room", tmp_path / "neighbour.py"
    for folder in (tmp_path, room):
        (folder / "__pycache__").mkdir(parents=True)
    neighbour.write_text("1")

    def left():
        for folder in (tmp_path, room):
            (folder / "__pycache__" / "old.nbi").touch()
        compiled.forget_stale(tmp_path)
        return len(list(tmp_path.rglob("*.nbi")))

    assert left() == 0 and left() == 2
    neighbour.write_text("2")
    os.utime(neighbour, (100, 100))  # older than all that was compiled
    assert left() == 0 and left() == 2
    os.utime(neighbour)
    assert left() == 2
    compiled.forget_stale(tmp_path / "nothing")
