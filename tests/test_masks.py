from itertools import pairwise

import cv2
import numpy as np
import pytest

from thesis_repro import InputError, masks
from thesis_repro.cityscapes import ID
from thesis_repro.kitti import Sequence


def halves(left, right):
    label_map = np.full((32, 32), ID[left], np.uint8)
    label_map[:, 16:] = ID[right]
    return label_map


def test_canny_misses_neighbouring_ids_and_exact_does_not():
    # road 7 and sidewalk 8 differ by one: too little for thresholds of 5 and 15
    assert not masks.edges(halves("road", "sidewalk"), (64, 96)).any()
    exact = masks.edges(halves("road", "sidewalk"), (64, 96), boundaries="exact")
    assert np.array_equal(np.unique(np.nonzero(exact)[1]), [47])
    found = masks.edges(halves("road", "sky"), (64, 96))
    assert set(np.unique(found)) == {0, 255} and abs(np.nonzero(found)[1] - 47.5).max() <= 1


@pytest.mark.parametrize("width", [1, 2, 5, 10, 15])
def test_dilation_gives_a_square_of_that_width(width):
    point = np.zeros((41, 41), np.uint8)
    point[20, 20] = 255
    rows, columns = np.nonzero(masks.dilate(point, width))
    assert np.ptp(rows) + 1 == np.ptp(columns) + 1 == width and len(rows) == width**2
    # the even square has no centre: it lies half a pixel off, as the thesis's does
    assert rows.mean() == 20 + (0.5 if width % 2 == 0 else 0) or rows.mean() == 20 - (0.5 if width % 2 == 0 else 0)


def test_wider_masks_hold_narrower_ones():
    label_map = np.random.default_rng(0).choice([7, 23, 26], (20, 20)).astype(np.uint8).repeat(16, 0).repeat(16, 1)
    kept = [masks.keypoint_mask(label_map, (94, 310), width) for width in (1, 3, 5, 7)]
    assert all((wide >= narrow).all() for narrow, wide in pairwise(kept))
    assert 0 < masks.coverage(kept[0]) < masks.coverage(kept[-1]) <= 1


@pytest.fixture
def labelled(tiny_kitti, tmp_path):
    sequence = Sequence(tiny_kitti, "00")
    folder = tmp_path / "labels"
    folder.mkdir()
    for path in sequence.frame_paths:
        cv2.imwrite(str(folder / path.name), halves("road", "sky"))
    return sequence, folder


def test_label_masks_are_the_filter_of_each_frame(labelled):
    sequence, folder = labelled
    made = masks.LabelMasks(folder, sequence, 5)
    assert len(made) == 4 and np.array_equal(made[3], masks.keypoint_mask(halves("road", "sky"), (48, 64), 5))


def test_stored_masks_give_the_same(labelled, tmp_path):
    sequence, folder = labelled
    (tmp_path / "masks").mkdir()
    for index, path in enumerate(sequence.frame_paths):
        cv2.imwrite(str(tmp_path / "masks" / path.name), masks.LabelMasks(folder, sequence, 5)[index])
    assert np.array_equal(masks.MaskFolder(tmp_path / "masks", sequence)[1], masks.LabelMasks(folder, sequence, 5)[1])


def test_faults_are_named(labelled, tmp_path):
    sequence, folder = labelled
    with pytest.raises(InputError, match="dilation width 0: must be 1"):
        masks.LabelMasks(folder, sequence, 0)
    with pytest.raises(InputError, match="nowhere: no such folder"):
        masks.MaskFolder(tmp_path / "nowhere", sequence)
    with pytest.raises(InputError, match="000000.png: 32x32 pixels, but the frames have 64x48"):
        masks.MaskFolder(folder, sequence)[0]
    (folder / "000002.png").unlink()
    with pytest.raises(InputError, match="000002.png: no such mask .1 of 4 frames"):
        masks.MaskFolder(folder, sequence)
    with pytest.raises(InputError, match="unknown; choose one of canny, exact"):
        masks.edges(halves("road", "sky"), (48, 64), boundaries="fuzzy")
