"""Folders of results: their inputs, their locks and digests."""

import fcntl
import os
from importlib import metadata
from unittest.mock import Mock

import numpy as np
import pytest

from thesis_repro.errors import InputError
from thesis_repro.running import files, provenance


def test_a_stage_keeps_results_of_the_same_inputs(tmp_path):
    folder = provenance.stage(tmp_path / "a", data="one", size=3)
    files.write_text(folder / "result", "kept")
    assert provenance.stage(tmp_path / "a", size=3, data="one") == folder
    assert (folder / "result").exists()
    provenance.stage(tmp_path / "a", data="other", size=3)
    assert not (folder / "result").exists()
    with pytest.raises(InputError, match="a: .*size"):
        provenance.stage(folder, replace=False, data="other", size=4)
    assert provenance.record(folder) == {"data": "other", "size": 3}


def test_a_folder_with_other_files_is_refused_and_kept(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match=str(tmp_path)):
        provenance.stage(tmp_path, data="one")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
    (tmp_path / provenance.RECORD).write_text("[1, 2")  # a damaged record
    with pytest.raises(InputError, match="made-from.json: "):
        provenance.stage(tmp_path, data="one")


def test_a_folder_with_what_a_system_puts_there_is_empty(tmp_path):
    (tmp_path / "lost+found").mkdir()
    for name in (".DS_Store", "._a", ".nfs000000000000000100000001"):
        (tmp_path / name).touch()
    provenance.stage(tmp_path, data="one")
    assert provenance.record(tmp_path) == {"data": "one"}


def test_results_of_other_inputs_move_aside_with_all_that_was_added(tmp_path, monkeypatch):
    folder = provenance.stage(tmp_path / "a", size=3)
    monkeypatch.chdir(folder)
    for size in (3, 4, 5):
        provenance.stage(".", size=size)  # "." has no name
        files.write_text(folder / "in" / "result", f"result of {size}")
        (folder / "link").symlink_to("/nowhere")
        (folder / ".env").write_text(f"by hand, {size}")
    provenance.stage(folder, size=5)
    for path, size in ((folder, 5), (tmp_path / "a.old-1", 3), (tmp_path / "a.old-2", 4)):
        assert provenance.record(path) == {"size": size} and (path / "link").is_symlink()
        assert (path / "in" / "result").read_text() == f"result of {size}"
        assert (path / ".env").read_text() == f"by hand, {size}"


def test_a_killed_move_of_old_results_is_finished(tmp_path, monkeypatch):
    folder = provenance.stage(tmp_path / "out", size=3)
    for path in (folder / "result", folder / "in" / "result"):
        files.write_text(path, "old")
    rename = type(folder).rename

    def killed(path, target):
        rename(path, target)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(folder), "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            provenance.stage(folder, size=4)
    assert provenance.record(folder) == {"size": 3}
    provenance.stage(folder, size=4)
    assert [path.name for path in folder.iterdir()] == [provenance.RECORD]
    assert len(list(tmp_path.glob("out.old-*/**/result"))) == 2


def test_a_folder_is_locked_by_one_process(tmp_path):
    folder = tmp_path / "out"
    with provenance.claimed(folder):
        with provenance.claimed(folder):  # one process may lock it twice
            provenance.stage(folder, size=3)
        other = os.open(folder, os.O_RDONLY)  # as in another process
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(InputError, match="out: "):
        provenance.stage(folder)
    os.close(other)
    provenance.stage(folder, size=4)


def test_temporary_files_of_a_killed_run_are_deleted(tmp_path):
    folder = provenance.stage(tmp_path / "out", size=3)
    hidden = folder / "in" / ".hidden"
    for path in (hidden, files.temporary_path(folder / "in/a.png"), folder / "in/b"):
        files.write_text(path, "")
    provenance.stage(folder, size=3)
    assert {path.name for path in (folder / "in").iterdir()} == {".hidden", "b"}


def test_digests_change_with_the_bytes_and_the_names(tmp_path):
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_text("12")
    first = provenance.digest_of_files(paths)
    paths[1].write_text("21")
    second = provenance.digest_of_files(paths)
    paths[1] = paths[1].rename(tmp_path / "c")
    assert len({first, second, provenance.digest_of_files(paths)}) == 3


@pytest.mark.parametrize(
    "path, changes", [("a/in/one.py", True), ("b.py", True), ("c.py", False), ("a/data.csv", False)]
)
def test_the_digest_of_code_changes_with_any_module_of_its_folders(
    tmp_path, monkeypatch, path, changes
):
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    for name in ("a/in/one.py", "b.py"):
        files.write_text(tmp_path / name, "ONE = 1")
    digests = []
    for text in ("ONE = 1", "ONE = 1  # a comment"):
        files.write_text(tmp_path / path, text)
        provenance.digest_of_code.cache_clear()
        digests.append(provenance.digest_of_code("a", "b.py"))
    provenance.digest_of_code.cache_clear()
    assert (digests[0] != digests[1]) == changes


def test_a_package_that_another_distribution_brings_has_a_version(monkeypatch):
    """As tensorflow-cpu brings tensorflow."""
    none = Mock(side_effect=metadata.PackageNotFoundError)
    monkeypatch.setattr(provenance.metadata, "version", none)
    assert provenance.versions("numpy")["versions"]["numpy"] == np.__version__
