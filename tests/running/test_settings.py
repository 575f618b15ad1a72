import pytest

from thesis_repro.errors import InputError
from thesis_repro.running.settings import PROFILES, read_settings


def test_the_default_run():
    settings = read_settings({})
    assert settings.run == "embedded-demo" and settings.figures.name == "figures"
    assert (
        settings.kitti_is_embedded
        and settings.kitti == settings.world / "kitti"
        and not settings.uses_shipped_model
    )
    sizes = PROFILES["thesis"]
    assert (sizes.image_size, sizes.base_filters, sizes.batch_size) == (320, 64, 16)
    assert (sizes.epochs, sizes.patience) == (100, 5)
    assert (
        sizes.frames is None
        and sizes.training_images is None
        and sizes.widths == tuple(range(1, 16))
    )


def test_runs_of_different_data_or_profiles_have_different_folders(tmp_path):
    one, two = tmp_path / "a" / "kitti", tmp_path / "b" / "kitti"
    one.mkdir(parents=True), two.mkdir(parents=True)
    environments = [{}, {"THESIS_REPRO_PROFILE": "smoke"}] + [
        {"THESIS_REPRO_KITTI": str(kitti), **more}
        for kitti in (one, two)
        for more in ({}, {"THESIS_REPRO_PROFILE": "smoke"}, {"THESIS_REPRO_CITYSCAPES": str(one)})
    ]
    runs = [read_settings(environment) for environment in environments]
    assert (
        len({settings.build for settings in runs})
        == len({settings.figures for settings in runs})
        == len(runs)
    )
    settings, default = (
        read_settings({"THESIS_REPRO_KITTI_SEMANTIC": str(tmp_path)}),
        read_settings({}),
    )
    assert settings.kitti_semantic == tmp_path and default.kitti_semantic is None
    assert (
        settings.run != default.run
        and settings.world == default.world
        and settings.run in str(settings)
    )


def test_changed_sizes_are_part_of_the_name():
    changes = {
        "EPOCHS": "3",
        "FRAMES": "all",
        "WIDTHS": "5,10",
        "IMAGE_SIZE": "64",
        "REPETITIONS": str(PROFILES["demo"].repetitions),
    }
    settings = read_settings({f"THESIS_REPRO_{name}": value for name, value in changes.items()})
    sizes = settings.sizes
    assert (sizes.epochs, sizes.frames, sizes.widths, sizes.image_size) == (3, None, (5, 10), 64)
    # a size equal to the profile's is not in the name
    assert settings.run == "embedded-demo-image-size-64-epochs-3-frames-all-widths-5_10"
    assert (
        sizes.batch_size == PROFILES["demo"].batch_size
        and settings.figures != read_settings({}).figures
    )
    assert (
        read_settings({"THESIS_REPRO_FRAMES": "200", "THESIS_REPRO_WIDTHS": "1-15"}).run
        == "embedded-demo"
    )
    many = read_settings({"THESIS_REPRO_WIDTHS": "1-40"})
    assert many.sizes.widths == tuple(range(1, 41)) and len(many.run) < 60


def test_real_frames_alone_use_the_shipped_model(tmp_path):
    settings = read_settings({"THESIS_REPRO_KITTI": str(tmp_path)})
    assert settings.uses_shipped_model and "embedded" not in settings.data_note
    assert not read_settings(
        {"THESIS_REPRO_KITTI": str(tmp_path), "THESIS_REPRO_CITYSCAPES": str(tmp_path)}
    ).uses_shipped_model


@pytest.mark.parametrize(
    "setting",
    [
        "EPOCHS=0",
        "IMAGE_SIZE=100",
        "FRAMES=some",
        "WIDTHS=5-1",
        "WIDTHS=5,x",
        "WIDTHS=1-1000000000",
        "BASE_FILTERS=nan",
        "PROFILE=huge",
        "KITTI=/no/such/folder",
        "KITTI_SEMANTIC=/no/such/folder",
        "JOBS=many",
        "PROFIL=demo",
    ],
)
def test_bad_settings_are_named(setting):
    name, value = setting.split("=")
    with pytest.raises(InputError, match=f"{name}.*: "):
        read_settings({f"THESIS_REPRO_{name}": value})
