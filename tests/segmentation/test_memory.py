import pytest

from thesis_repro import InputError
from thesis_repro.segmentation import memory
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow


def test_a_batch_that_cannot_fit_is_refused(monkeypatch):
    model = build_unet((64, 64, 1), 35, 4)
    monkeypatch.setattr(memory, "available", lambda: memory.needed(model, 3) - 1)
    memory.require(model, 2)
    with pytest.raises(InputError, match="batch_size=3:"):
        memory.require(model, 3)


def test_a_containers_limit_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    free = memory.available()
    (tmp_path / "memory.current").write_text(f"{2**20}\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() > free / 2
    (tmp_path / "memory.max").write_text(f"{2**27}\n")
    assert memory.available() == 2**27 - 2**20


def test_memory_needed_by_the_thesiss_batch():
    # 600 channels at full size are kept for the gradients
    row = 16 * 320 * 320 * 4  # bytes of one channel at full size in a batch of 16
    assert 600 * row < memory.needed(build_unet((320, 320, 1), 35), 16) < 20e9
