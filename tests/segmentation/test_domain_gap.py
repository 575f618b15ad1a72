"""The quality of label maps on several domains."""

import pytest

from thesis_repro import cityscapes, kitti
from thesis_repro.segmentation import domain_gap
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow


def test_models_are_measured_on_each_domain(small_world):
    model = build_unet((32, 32, 1), cityscapes.N_CLASSES, 2)
    drives = [kitti.Sequence(small_world / "kitti", name).subset(3) for name in ("00", "01")]
    frames = domain_gap.labelled_frames(drives)
    assert len(set(frames)) == 6
    domains = {"streets": cityscapes.pairs(small_world / "cityscapes", "val"), "frames": frames}
    gap = domain_gap.measure({"tiny": model}, domains)
    assert gap.scores["domain"].tolist() == ["streets", "frames"]
    assert gap.scores["images"].tolist() == [len(pairs) for pairs in domains.values()]
    present = gap.classes.groupby("domain", sort=False)
    assert gap.scores["classes"].tolist() == present.size().tolist()
    assert gap.scores["mean_iou"].tolist() == pytest.approx(present["iou"].mean().tolist())
    assert present["share"].sum().tolist() == pytest.approx([1, 1])
