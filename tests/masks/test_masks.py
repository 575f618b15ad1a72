import platform
import shutil
import zlib

import cv2
import numpy as np
import pytest

from thesis_repro import masks
from thesis_repro.data.cameras import Camera
from thesis_repro.data.cityscapes import ID, resize_bilinear
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import MaskSettings, folders
from thesis_repro.running import provenance

SIZE = (376, 1240)
# on x86_64
RECORDED = {
    "label map, enlarged": 3492872803,
    "mask": 243009454,
    "frame of the network": 1817078014,
}


def bands(*names):
    """A label map of vertical bands, 16 pixels each."""
    return np.repeat(
        np.array([[ID[name] for name in names]], np.uint8).repeat(16, axis=1), 32, axis=0
    )


def streets():
    """A label map of blocks; enlarged to SIZE, no boundary lies on the centre of a pixel."""
    return (
        np.random.default_rng(0)
        .choice([7, 8, 11, 23, 26], (20, 20))
        .astype(np.uint8)
        .repeat(16, 0)
        .repeat(16, 1)
    )


def test_canny_misses_boundaries_of_neighbouring_ids_and_exact_finds_them():
    # road 7 and sidewalk 8 differ by one: too little for thresholds of 5 and 15
    assert not masks.edges(bands("road", "sidewalk"), (64, 96)).any()
    exact = masks.edges(bands("road", "sidewalk"), (64, 96), MaskSettings("exact"))
    assert np.array_equal(np.unique(np.nonzero(exact)[1]), [47])
    canny = masks.edges(bands("road", "sky"), (64, 96))
    assert set(np.unique(canny)) == {0, 255} and abs(np.nonzero(canny)[1] - 47.5).max() <= 1
    right = np.zeros((64, 96), np.uint8)
    right[:, 48:] = 255  # half of the true boundary, which has two sides
    assert masks.boundaries_found(right, bands("road", "sky")) == 0.5
    assert np.isnan(masks.boundaries_found(right, bands("road")))


@pytest.mark.parametrize("width", [1, 2, 5, 10, 15])
def test_dilation_gives_a_square_of_that_width(width):
    image = np.zeros((41, 41), np.uint8)
    image[20, 20] = 255
    rows, columns = np.nonzero(masks.dilate(image, width))
    assert np.ptp(rows) + 1 == np.ptp(columns) + 1 == width and len(rows) == width**2
    # a square of even width is half a pixel off, as in the thesis
    assert abs(rows.mean() - 20) == (0.5 if width % 2 == 0 else 0)
    symmetric = masks.dilate(image, width, symmetric=True)
    assert masks.coverage(symmetric) * 41**2 == pytest.approx((width - 1 + width % 2) ** 2)


@pytest.mark.parametrize("width", [2, 5, 10])
def test_symmetric_masks_commute_with_mirroring(width):
    def differing(settings):
        made = masks.keypoint_mask(streets(), SIZE, width, settings)
        return [
            (
                masks.keypoint_mask(cv2.flip(streets(), axis), SIZE, width, settings)
                != cv2.flip(made, axis)
            ).mean()
            for axis in (0, 1)
        ]

    assert differing(MaskSettings("exact", symmetric=True)) == [0, 0]
    assert max(differing(MaskSettings("exact"))) > 0.01


@pytest.mark.parametrize("boundaries", masks.BOUNDARIES)
def test_only_boundaries_of_chosen_classes(boundaries):
    # (road/car at column 32, car/building at 64): whether each boundary is in the mask
    def around(*classes):
        columns = masks.keypoint_mask(
            bands("road", "car", "building"), (64, 96), 3, MaskSettings(boundaries, classes=classes)
        ).any(axis=0)
        assert not np.delete(columns, np.r_[28:37, 60:69]).any()
        return bool(columns[28:37].any()), bool(columns[60:69].any())

    assert around("road") == (True, False) and around("building") == (False, True)
    assert around("car") == around() == (True, True)
    assert around("pole") == (False, False)


def test_no_keypoints_on_movable_classes_and_within_the_margin():
    def columns(movable):
        settings = MaskSettings("exact", movable=movable)
        return np.flatnonzero(
            masks.keypoint_mask(bands("road", "car", "building"), (64, 96), 9, settings).all(axis=0)
        )

    assert columns(None).tolist() == [*range(27, 36), *range(59, 68)]
    assert columns(0).tolist() == [*range(27, 32), *range(64, 68)]  # the car is at columns 32 to 63
    assert columns(2).tolist() == [*range(27, 30), *range(66, 68)]
    plain, inside = (
        masks.keypoint_mask(streets(), SIZE, 5, MaskSettings(margin=margin)) for margin in (0, 7)
    )
    expected = np.zeros_like(plain)
    expected[7:-7, 7:-7] = plain[7:-7, 7:-7]
    assert np.array_equal(inside, expected) and plain[:7].any()
    assert not masks.keypoint_mask(streets(), SIZE, 5, MaskSettings(margin=200)).any()


@pytest.mark.parametrize("boundaries", masks.BOUNDARIES)
def test_other_masks_of_the_literature(boundaries):
    label_map = bands("road", "building", "car").repeat(2, axis=1)  # bands of 32 pixels

    def kept(**options):  # the columns
        mask = masks.keypoint_mask(
            label_map, label_map.shape, 5, MaskSettings(boundaries, **options)
        )
        return set(np.flatnonzero(mask.all(axis=0)))

    thesis = kept()
    assert {31, 32, 63, 64} <= thesis and len(thesis) < 16
    assert kept(keep="inverse") == set(range(96)) - thesis
    assert kept(keep="static-boundaries") == {column for column in thesis if column < 40}
    assert kept(keep="static") == set(range(64 - masks.DYNASLAM_MARGIN))
    assert kept(keep="static", movable=0) == set(range(64))


@pytest.fixture
def labelled(tiny_kitti, tmp_path):
    sequence = Sequence(tiny_kitti, "00")
    folder = tmp_path / "labels"
    folder.mkdir()
    for path in sequence.frame_paths:
        cv2.imwrite(str(folder / path.name), bands("road", "sky"))
    return sequence, folder


def test_label_masks_and_written_masks_equal_the_filter_of_the_label_maps_there_now(
    labelled, tmp_path
):
    sequence, folder = labelled
    corrections = MaskSettings("exact", symmetric=True, classes=("sky",), movable=1, margin=3)
    for settings in (corrections, MaskSettings()):
        made = folders.LabelMasks(folder, sequence, 4, settings)
        assert len(made) == 4 and "4 masks of 64x48 pixels, dilation width 4" in repr(made)
        for names in (("road", "sky"), ("sky", "road", "sky"), ("road", "sky", "car")):
            for path in made.paths:
                cv2.imwrite(str(path), bands(*names))
            expected = masks.keypoint_mask(bands(*names), (48, 64), 4, settings)
            assert np.array_equal(made[3], expected)  # it was read last before
            folders.write_masks(made, tmp_path / "masks")  # in the place of those before
            written = folders.MaskFolder(tmp_path / "masks", sequence)
            for index in range(4):
                assert np.array_equal(made[index], expected)
                assert np.array_equal(written[index], expected)


def test_a_mask_named_as_a_frame_is_that_frames(tiny_kitti, tmp_path):
    sequence, folder = Sequence(tiny_kitti, "00"), tmp_path / "masks"
    mask = sequence.label_names[2]
    folder.mkdir()
    cv2.imwrite(str(folder / mask), np.full((48, 64), 255, np.uint8))
    for frames in (sequence, sequence.subset(2)):
        with pytest.raises(InputError, match="no such mask"):
            folders.MaskFolder(folder, frames)
    (folder / mask).rename(folder / "bonnet.png")
    assert set(folders.MaskFolder(folder, sequence).paths) == {folder / "bonnet.png"}


@pytest.mark.parametrize(
    "setting, value",
    [
        ("boundaries", "fuzzy"),
        ("classes", ("hedge",)),
        ("movable", -1),
        ("margin", -3),
        ("keep", "most"),
    ],
)
def test_wrong_settings_are_named(setting, value):
    with pytest.raises(InputError, match=setting):
        MaskSettings(**{setting: value})


def test_the_thesis_mask_is_its_three_calls():
    label_map = streets()
    enlarged = resize_bilinear(label_map, SIZE)
    for width in (1, 5, 10):
        expected = cv2.dilate(cv2.Canny(enlarged, 5, 15), np.ones((width, width), np.uint8))
        assert np.array_equal(masks.thesis_mask(label_map, SIZE, width), expected)
        assert np.array_equal(masks.keypoint_mask(label_map.astype(int), SIZE, width), expected)


@pytest.mark.bits
def test_frames_and_masks_have_the_bits_recorded_on_x86():
    label_map = streets()
    frame = np.random.default_rng(1).integers(0, 256, SIZE, np.uint8)
    images = {
        "label map, enlarged": resize_bilinear(label_map, SIZE),
        "mask": masks.thesis_mask(label_map, SIZE, 10),
        "frame of the network": resize_bilinear(frame, (320, 320)),
    }
    assert {name: zlib.crc32(image.tobytes()) for name, image in images.items()} == RECORDED
    if platform.machine() == "x86_64":  # elsewhere OpenCV may round one channel differently
        assert np.array_equal(images["label map, enlarged"], cv2.resize(label_map, SIZE[::-1]))
        assert np.array_equal(images["frame of the network"], cv2.resize(frame, (320, 320)))


@pytest.mark.parametrize(
    "label_map",
    [[[35]], [[-1, 7]], [[7.0]], [7, 7], [[]], [[[7]]]],
    ids=["above", "below", "float", "one row", "empty", "channels"],
)
def test_label_maps_of_another_kind_are_refused(label_map):
    with pytest.raises(InputError, match="label map"):
        masks.keypoint_mask(np.array(label_map), (4, 4), 2)
    assert not masks.keypoint_mask(np.array([[34]]), (4, 4), 2).any()
    with pytest.raises(InputError, match="dilation width None"):
        masks.keypoint_mask(np.array([[7]]), (4, 4))


def test_wrong_arguments_are_named(labelled):
    sequence, folder = labelled
    folders.LabelMasks(folder, sequence, 128)  # covers the frame, 48x64
    for width in (0, 2.0, 129):
        with pytest.raises(InputError, match=f"dilation width {width}"):
            folders.LabelMasks(folder, sequence, width)
    sequence.lens = Camera(np.eye(3), np.ones(4))
    folders.LabelMasks(folder, sequence, 4)  # somebody's, of whichever frames
    provenance.stage(folder / "predicted", model="of raw frames")
    for path in sequence.frame_paths:
        shutil.copy(folder / path.name, folder / "predicted")
    with pytest.raises(InputError, match="predicted: made of frames with other distortion"):
        folders.LabelMasks(folder / "predicted", sequence, 4)
