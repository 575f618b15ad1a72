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


# The corrections, each by itself

PLAIN = masks.MaskSettings()


def streets():
    """A label map of blocks of a few classes; none of its boundaries lies on a pixel's centre when enlarged to SIZE."""
    return np.random.default_rng(0).choice([7, 8, 11, 23, 26], (20, 20)).astype(np.uint8).repeat(16, 0).repeat(16, 1)


SIZE = (376, 1240)


def test_without_corrections_masks_are_the_thesiss_to_the_bit():
    enlarged = cv2.resize(streets(), SIZE[::-1])
    theirs = cv2.dilate(cv2.Canny(enlarged, 5, 15), np.ones((10, 10), np.uint8))
    assert np.array_equal(masks.keypoint_mask(streets(), SIZE, 10), theirs)
    assert np.array_equal(masks.keypoint_mask(streets(), SIZE, 10, PLAIN), theirs)
    assert np.array_equal(masks.keypoint_mask(streets(), SIZE, 10, "exact"),
                          masks.keypoint_mask(streets(), SIZE, 10, masks.MaskSettings(boundaries="exact")))


@pytest.mark.parametrize("width", [2, 5, 10])
def test_a_symmetric_mask_of_a_mirrored_label_map_is_the_mirrored_mask(width):
    def differing(settings):
        made = masks.keypoint_mask(streets(), SIZE, width, settings)
        return [(masks.keypoint_mask(cv2.flip(streets(), axis), SIZE, width, settings) != cv2.flip(made, axis)).mean()
                for axis in (0, 1)]

    assert differing(masks.MaskSettings("exact", symmetric=True)) == [0, 0]
    assert max(differing(masks.MaskSettings("exact"))) > 0.01


def test_a_symmetric_band_lies_in_the_middle_of_its_boundary():
    def columns(width, settings):  # the boundary is between columns 47 and 48
        return np.unique(np.nonzero(masks.keypoint_mask(halves("road", "sky"), (64, 96), width, settings))[1])

    assert columns(10, masks.MaskSettings("exact", symmetric=True)).tolist() == list(range(43, 53))
    assert columns(5, masks.MaskSettings("exact", symmetric=True)).tolist() == list(range(45, 51))
    assert columns(5, masks.MaskSettings("exact")).tolist() == list(range(45, 50))
    point = np.zeros((41, 41), np.uint8)
    point[20, 20] = 255
    rows, across = np.nonzero(masks.dilate(point, 10, symmetric=True))
    assert rows.mean() == across.mean() == 20 and len(rows) == 81


def thirds():
    label_map = np.full((32, 48), ID["road"], np.uint8)
    label_map[:, 16:32], label_map[:, 32:] = ID["car"], ID["building"]
    return label_map


@pytest.mark.parametrize("boundaries", masks.BOUNDARIES)
def test_boundaries_of_chosen_classes_alone(boundaries):
    def around(*classes):  # whether the boundary road/car, at column 32, and car/building, at 64, is found
        found = masks.keypoint_mask(thirds(), (64, 96), 3, masks.MaskSettings(boundaries, classes=classes)).any(axis=0)
        assert not np.delete(found, np.r_[28:37, 60:69]).any()
        return bool(found[28:37].any()), bool(found[60:69].any())

    assert around("road") == (True, False) and around("building") == (False, True)
    assert around("car") == around() == (True, True)
    assert around("pole") == (False, False)


def test_no_keypoints_on_movable_classes():
    label_map = thirds()
    without = {grown: masks.keypoint_mask(label_map, (64, 96), 9, masks.MaskSettings("exact", movable=grown)) > 0
               for grown in (None, 0, 2)}
    assert without[None][:, 32:36].all()  # on the car, along its boundary
    assert not without[0][:, 32:64].any() and without[0][:, 28:32].all() and without[0][:, 64:68].all()
    assert not without[2][:, 30:66].any() and without[2][:, 28:30].all() and without[2][:, 66:68].all()


def test_nothing_is_kept_within_the_margin():
    mask = masks.keypoint_mask(streets(), SIZE, 5, masks.MaskSettings(margin=7))
    plain = masks.keypoint_mask(streets(), SIZE, 5)
    assert np.array_equal(mask[7:-7, 7:-7], plain[7:-7, 7:-7]) and plain[:7].any()
    inside = np.zeros_like(mask)
    inside[7:-7, 7:-7] = 1
    assert not mask[inside == 0].any()
    assert not masks.keypoint_mask(streets(), SIZE, 5, masks.MaskSettings(margin=200)).any()


def test_label_masks_and_written_ones_have_the_corrections_that_are_asked_for(labelled, tmp_path):
    sequence, folder = labelled
    settings = masks.MaskSettings("exact", symmetric=True, classes=("sky",), movable=1, margin=3)
    made = masks.LabelMasks(folder, sequence, 4, settings)
    expected = masks.keypoint_mask(halves("road", "sky"), (48, 64), 4, settings)
    assert np.array_equal(made[1], expected) and not np.array_equal(masks.LabelMasks(folder, sequence, 4)[1], expected)
    masks.write_masks(made, tmp_path / "masks")
    assert np.array_equal(masks.MaskFolder(tmp_path / "masks", sequence)[1], expected)
    masks.write_masks(masks.LabelMasks(folder, sequence, 4), tmp_path / "masks")  # nothing of the others is left
    assert not np.array_equal(masks.MaskFolder(tmp_path / "masks", sequence)[1], expected)


@pytest.mark.parametrize("settings, says", [
    ({"boundaries": "fuzzy"}, "boundaries='fuzzy': unknown; choose one of canny, exact"),
    ({"classes": ("hedge",)}, "classes: 'hedge' is no label; known are unlabeled, "),
    ({"movable": -1}, "movable=-1: must be 0 or more"), ({"margin": -3}, "margin=-3: must be 0 or more")])
def test_settings_that_cannot_be_are_refused(settings, says):
    with pytest.raises(InputError, match=says):
        masks.MaskSettings(**settings)
