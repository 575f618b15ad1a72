import os

from thesis_repro import compiled


def test_caches_of_compiled_code_are_deleted_when_a_file_has_changed(tmp_path):
    folders, neighbour = (tmp_path, tmp_path / "room"), tmp_path / "neighbour.py"
    for folder in folders:
        (folder / "__pycache__").mkdir(parents=True)
    neighbour.write_text("1")

    def left():
        for folder in folders:
            (folder / "__pycache__" / "old.nbi").touch()
        compiled.forget_stale(tmp_path)
        return len(list(tmp_path.rglob("*.nbi")))

    assert left() == 0 and left() == 2
    neighbour.write_text("2")
    os.utime(neighbour, (100, 100))  # older than the compiled files
    assert left() == 0 and left() == 2
    os.utime(neighbour)
    assert left() == 2
    compiled.forget_stale(tmp_path / "nothing")
