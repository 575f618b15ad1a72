import sys

import pytest
from trials import PACKAGES, copy_project, run, snapshot, succeed

from thesis.run_settings import PROFILES, ROOT, read_settings
from thesis_repro.errors import InputError


def settings_of(**variables):
    return read_settings({f"THESIS_REPRO_{name}": str(text) for name, text in variables.items()})


def test_the_default_run():
    settings = settings_of()
    assert settings.run == "embedded-demo" and settings.figures_in_git
    assert settings.figures == ROOT / "build/embedded-demo/figures"
    assert settings.kitti == settings.world / "kitti" and not settings.uses_shipped_model
    sizes = PROFILES["thesis"]
    assert (sizes.image_size, sizes.base_filters, sizes.batch_size) == (320, 64, 16)
    assert (sizes.epochs, sizes.patience, sizes.frames) == (100, 5, None)
    assert sizes.widths == tuple(range(1, 16))


def test_runs_of_different_data_or_profiles_have_different_folders(tmp_path):
    one, two = tmp_path / "a" / "kitti", tmp_path / "b" / "kitti"
    one.mkdir(parents=True), two.mkdir(parents=True)
    runs = [settings_of(), settings_of(PROFILE="smoke"), settings_of(KITTI_SEMANTIC=one)]
    for kitti in (one, two):
        runs += [settings_of(KITTI=kitti), settings_of(KITTI=kitti, CITYSCAPES=one)]
    for places in ("build", "figures", "published"):
        assert len({getattr(settings, places) for settings in runs}) == len(runs)
    uses_shipped_model = [settings.uses_shipped_model for settings in runs]
    assert uses_shipped_model == [False, False, False, True, False, True, False]


def test_changed_sizes_are_part_of_the_name():
    settings = settings_of(EPOCHS=3, FRAMES="all", WIDTHS="5,10", IMAGE_SIZE=64, REPETITIONS=2)
    sizes = settings.sizes
    assert (sizes.epochs, sizes.frames, sizes.widths, sizes.image_size) == (3, None, (5, 10), 64)
    # a size equal to the profile's is not in the name
    assert settings.run == "embedded-demo-image-size-64-epochs-3-frames-all-widths-5_10"
    of_demo = PROFILES["demo"]
    widths = ",".join(map(str, of_demo.widths))
    assert settings_of(FRAMES=of_demo.frames, WIDTHS=widths).run == "embedded-demo"


@pytest.mark.parametrize(
    "setting",
    ["EPOCHS=0", "FRAMES=some", "WIDTHS=5-1", "WIDTHS=5,x", "BASE_FILTERS=nan", "PROFILE=huge"]
    + ["KITTI=/no/such/folder", "JOBS=many", "PROFIL=demo", "BUILD=a b", "BUILD=a:b", "BUILD=a#b"]
    + ["BUILD=a%b"],
)
def test_bad_settings_are_named(setting):
    name, text = setting.split("=")
    with pytest.raises(InputError, match=f"^{name}.*: "):
        settings_of(**{name: text})


def test_folders_begin_at_home_or_in_the_checkout(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "kitti").mkdir()
    at_home = settings_of(KITTI="~/kitti", BUILD="~/b", FIGURES="~/f")
    assert (at_home.kitti, at_home.build.parent) == (tmp_path / "kitti", tmp_path / "b")
    assert at_home.published.parent == tmp_path / "f"
    assert settings_of(BUILD="b").world == ROOT / "b/world-demo"


def test_a_copy_for_the_lab_uses_the_results_of_the_checkout(tmp_path):
    copy_project(["notebooks/thesis"], tmp_path)
    code = "import thesis.run_settings as s; print(s.__file__, s.read_settings({}).build)"
    run = succeed([sys.executable, "-c", code], tmp_path / "notebooks", PYTHONPATH=ROOT)
    used, build = run.stdout.split()
    assert used.startswith(str(tmp_path)) and build == str(ROOT / "build/embedded-demo")


def test_notebooks_beside_an_installed_package_say_that_they_need_a_checkout(tmp_path):
    copy_project([*PACKAGES, "notebooks"], tmp_path)  # without what only a checkout has
    path = f"{tmp_path}:{tmp_path}/notebooks"
    before = snapshot(tmp_path)
    failed = run([sys.executable, "-c", "import thesis.run_settings"], tmp_path, PYTHONPATH=path)
    assert failed.returncode == 1 and "InputError" in failed.stderr.splitlines()[-1]
    assert "checkout" in failed.stderr.splitlines()[-1]
    assert {name for name in snapshot(tmp_path) if "__pycache__" not in name.parts} == set(before)
