import os

from thesis_repro import compiled


def test_what_was_compiled_before_a_neighbour_changed_is_forgotten_whatever_the_dates_are(tmp_path):
    cache, inner = tmp_path / "__pycache__", tmp_path / "inner.py"
    (tmp_path / "outer.py").touch()
    inner.write_text("1")

    def kept():
        (cache / "old.nbi").touch()
        compiled.forget_stale(tmp_path)
        return [path.name for path in cache.glob("*.nbi")]

    cache.mkdir()
    assert kept() == [] and kept() == ["old.nbi"]
    inner.write_text("2")
    os.utime(inner, (100, 100))  # older than all that was compiled
    assert kept() == [] and kept() == ["old.nbi"]
    os.utime(inner)
    assert kept() == ["old.nbi"]
    compiled.forget_stale(tmp_path / "nothing")
