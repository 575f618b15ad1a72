import os

from thesis_repro import compiled


def test_what_was_compiled_before_a_neighbour_changed_is_forgotten(tmp_path):
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    for name, time in (("outer.py", 100), ("inner.py", 300)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time, time))
    for name, time in (("old.nbi", 200), ("new.nbi", 400)):
        (cache / name).touch()
        os.utime(cache / name, (time, time))
    compiled.forget_stale(tmp_path)
    assert [path.name for path in cache.iterdir()] == ["new.nbi"]
    compiled.forget_stale(tmp_path / "nothing")
