import os
import shutil

import numpy as np
import pytest

from thesis_repro import InputError, files, results


def test_a_stage_keeps_results_of_the_same_inputs(tmp_path):
    folder = results.stage(tmp_path / "a", data="one", size=3)
    files.write_text(folder / "result", "kept")
    assert (
        results.stage(tmp_path / "a", size=3, data="one") == folder and (folder / "result").exists()
    )
    before = results.made_from(folder)
    results.stage(tmp_path / "a", data="other", size=3)
    assert not (folder / "result").exists() and results.made_from(folder) != before
    with pytest.raises(InputError, match="a: .*size"):
        results.stage(folder, replace=False, data="other", size=4)
    assert results.record(folder) == {"data": "other", "size": 3}


def test_a_folder_with_other_files_is_refused_and_kept(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match=str(tmp_path)):
        results.stage(tmp_path, data="one")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
    (tmp_path / results.RECORD).write_text("[1, 2")  # a damaged record
    with pytest.raises(InputError, match="made-from.json: "):
        results.stage(tmp_path, data="one")


def test_a_checkpoint_is_read_back_and_holds_no_code(tmp_path):
    file = tmp_path / "state.npz"
    assert results.resume(file) is None
    results.store(file, {"epoch": 3}, {"0": np.eye(2), "job": np.arange(3)})
    job, arrays = results.resume(file)
    assert (
        job == {"epoch": 3}
        and np.array_equal(arrays["0"], np.eye(2))
        and np.array_equal(arrays["job"], [0, 1, 2])
    )
    np.savez(file, job="{}", **{"array 0": np.array([object()])})  # a pickle
    with pytest.raises(InputError, match="state.npz: "):
        results.resume(file)
    results.store(file, {}, {"0": np.zeros(1000)})
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match="state.npz: "):
        results.resume(file)


def test_the_digest_of_code_ignores_comments_and_follows_imports(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "_PACKAGE", tmp_path / "package")
    plain = {
        "__init__": "",
        "room____init__": "",
        "house": "def f():\n    return 1\n",
        "garden": "x = 1\n",
        "room__table": "import beside\nfrom package.room import chair\n",
        "room__chair": "from package import house\n",
    }
    (tmp_path / "beside.py").touch()  # another package beside this one

    def version(place="room", **changed):
        for name, text in {**plain, **changed}.items():
            files.write_text(
                tmp_path / "package" / f"{name.replace('__', '/', name != '__init__')}.py", text
            )
        results.code.cache_clear()
        return results.code(place)

    first = version()
    assert version(house='# why\ndef f():\n    """What."""\n    return 1\n') == first
    assert version(house="def f():\n    return 2\n") != first
    assert version(room__chair="from package import house\nx = 2\n") != first
    assert version(garden="x = 2\n") == first
    assert version("room/table", house="def f():\n    return 2\n") != version("room/table")
    with pytest.raises(ImportError, match="attic"):
        version("attic")
    results.code.cache_clear()


def test_digests_of_files_change_with_the_bytes_and_are_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_BUILD", str(tmp_path / "build"))
    monkeypatch.setattr(results, "SETTLED", -1)
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_text("12")
    first = results.listing(paths)
    (tmp_path / "elsewhere").mkdir()
    assert results.listing([shutil.copy(path, tmp_path / "elsewhere") for path in paths]) == first
    date = paths[1].stat().st_mtime_ns
    paths[1].write_text("21")  # the same length and date
    os.utime(paths[1], ns=(date, date))
    changed = results.listing(paths)
    assert changed != first
    monkeypatch.setattr(results, "_sha256", None)  # nothing may be read
    assert results.listing(paths) == changed
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: "):
        results.listing([tmp_path / "pipe"])


def test_results_of_other_inputs_move_aside_with_all_that_was_added(tmp_path, capsys):
    folder = tmp_path / "a"
    for size in (3, 4, 5):
        results.stage(folder, size=size)
        files.write_text(folder / "in" / "result", f"result of {size}")
        (folder / "link").symlink_to("/nowhere")
        (folder / ".env").write_text(f"by hand, {size}")
    results.stage(folder, size=5)
    for path, size in ((folder, 5), (tmp_path / "a.old-1", 3), (tmp_path / "a.old-2", 4)):
        assert results.record(path) == {"size": size} and (path / "link").is_symlink()
        assert (path / "in" / "result").read_text() == f"result of {size}"
        assert (path / ".env").read_text() == f"by hand, {size}"
    assert capsys.readouterr().err.count("a.old-2") == 1
    results.stage(results.stage(tmp_path / "empty", size=1), size=2)
    assert not (tmp_path / "empty.old-1").exists()


@pytest.mark.parametrize(
    "text", ["", "frame,x\n0,1.0\n1,2", "frame,x\n0,1.0\n1,two\n", "frame,x\n0,1.0\n"]
)
def test_a_damaged_table_is_not_kept(tmp_path, text):
    for content, whole in (("frame,x\n0,1.0\n1,2.0\n", True), (text, False)):
        (tmp_path / "a.csv").write_text(content)
        assert (results.kept_table(tmp_path / "a.csv", rows=2) is not None) == whole
    assert results.kept_table(tmp_path / "b.csv") is None
