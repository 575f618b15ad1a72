from thesis_repro import stages


def test_a_stage_keeps_results_of_the_same_inputs_only(tmp_path):
    folder = stages.stage(tmp_path / "a", data="one", size=3)
    (folder / "result").write_text("kept")
    assert stages.stage(tmp_path / "a", size=3, data="one") == folder and (folder / "result").exists()
    before = stages.made_from(folder)
    stages.stage(tmp_path / "a", data="other", size=3)
    assert not (folder / "result").exists() and stages.made_from(folder) != before


def test_code_ignores_comments_and_docstrings(tmp_path, monkeypatch):
    monkeypatch.setattr(stages, "_PACKAGE", tmp_path)
    versions = []
    for text in ('def f():\n    return 1\n', '# why\ndef f():\n    """What."""\n    return 1\n', 'def f():\n    return 2\n'):
        (tmp_path / "module.py").write_text(text)
        versions.append(stages.code("module"))
    assert versions[0] == versions[1] != versions[2]


def test_listing_notices_other_files(tmp_path):
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_text("12")
    first = stages.listing(paths)
    assert stages.listing(paths) == first != stages.listing(paths[:1])
    paths[1].write_text("123")
    assert stages.listing(paths) != first
