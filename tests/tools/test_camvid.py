"""The training of the thesis's network, at tiny size: it goes on where it ended."""

import pandas as pd
import pytest

import camvid

pytestmark = pytest.mark.slow


def test_a_longer_training_goes_on_and_writes_curves_and_scores(
    tiny_cityscapes, tmp_path, monkeypatch
):
    monkeypatch.setenv("THESIS_REPRO_PROFILE", "smoke")
    monkeypatch.setenv("THESIS_REPRO_BUILD", str(tmp_path))
    monkeypatch.setenv("THESIS_REPRO_KITTI_SEMANTIC", str(tiny_cityscapes))
    monkeypatch.setattr(camvid.tf.config.threading, "set_intra_op_parallelism_threads", int)
    monkeypatch.setattr(camvid.tf.config.threading, "set_inter_op_parallelism_threads", int)
    histories = []
    for epochs in ("1", "2"):
        monkeypatch.setenv("THESIS_REPRO_EPOCHS", epochs)
        camvid.main(str(tiny_cityscapes))
        (folder,) = tmp_path.glob("camvid/*/figures")
        histories.append(pd.read_csv(folder / "figure_4_01.csv"))
    first, both = histories
    assert both["epoch"].tolist() == [1, 2] and (both["seconds"] > 0).all()
    assert both[:1].equals(first)  # the first epoch was not repeated
    facts = pd.read_csv(folder / "training.csv", index_col="training")["CamVid, here"]
    assert facts["epochs"] == "2" and facts["ended by early stopping"].startswith("no")
    scores = pd.read_csv(folder / "scores.csv")
    assert len(scores.columns) == 3 and (folder / "figure_4_03.webp").is_file()
