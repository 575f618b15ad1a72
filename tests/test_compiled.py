import os

from thesis_repro import compiled


def test_caches_of_compiled_code_are_deleted_when_a_file_has_changed(tmp_path):
    cache, module = tmp_path / "room" / "__pycache__" / "old.nbi", tmp_path / "neighbour.py"
    cache.parent.mkdir(parents=True)
    deleted = []
    # dates older than the cache's; neither an equal nor a new date says anything about the bytes
    for text, date in (("1", 1), ("1", 2), ("2", 2), ("2", 2)):
        module.write_text(text)
        os.utime(module, (date, date))
        cache.touch()
        compiled.forget_stale(tmp_path)
        deleted.append(not cache.exists())
    assert deleted == [True, False, True, False]
    compiled.forget_stale(tmp_path / "nothing")
