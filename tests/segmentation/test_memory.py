import pytest

from thesis_repro import InputError
from thesis_repro.segmentation import memory
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow


def test_a_batch_that_cannot_fit_is_refused(monkeypatch):
    model = build_unet((64, 64, 1), 35, 4)
    monkeypatch.setattr(memory, "available", lambda: memory.needed(model, 3, training=False) - 1)
    memory.require(model, 2)
    for arguments in ((3,), (2, True)):  # training takes far more
        with pytest.raises(InputError, match=f"batch_size={arguments[0]}:"):
            memory.require(model, *arguments)


def test_the_limits_of_the_process_and_of_the_container_count(monkeypatch, tmp_path):
    resource = pytest.importorskip("resource")
    limit, used = tmp_path / "memory.max", tmp_path / "memory.current"
    monkeypatch.setattr(memory, "CGROUPS", ((limit, used),))
    free = memory.available()
    for text, expected in (("max", None), (str(2**27), 2**27 - 2**20)):
        limit.write_text(text + "\n")
        used.write_text(f"{2**20}\n")
        assert memory.available() == expected if expected else memory.available() > free / 2
    limit.unlink()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (memory.psutil.Process().memory_info().vms + 2**28, before[1]))
    try:
        assert 2**27 < memory.available() <= 2**28
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_memory_needed_by_the_thesiss_batch():
    model = build_unet((320, 320, 1), 35)
    row = 16 * 320 * 320 * 4  # bytes of one channel at full size in a batch of 16

    # the widest layer at full size reads and gives 128 channels; 600 are kept for the way back at full size alone
    assert memory.needed(model, 16, training=False) == 256 * row
    assert 600 * row < memory.needed(model, 16, training=True) < 20e9
