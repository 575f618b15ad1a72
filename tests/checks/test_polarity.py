"""Whether the shape of masks tells that they are inverted."""

import cv2
import numpy as np
import pytest

from thesis_repro.checks.polarity import INVERTED, RIGHT, UNKNOWN, polarity
from thesis_repro.data.cityscapes import ID
from thesis_repro.masks import MOVABLE, MaskSettings, keypoint_mask

SIZE = 376, 1241


def street():
    """A label map: sky, a row of houses and trees, a road, poles and two cars."""
    label_map = np.full(SIZE, ID["sky"], np.uint8)
    for left in range(0, SIZE[1], 120):
        names = ("building", "vegetation")
        label_map[60 + left % 50 : 220, left : left + 120] = ID[names[left // 120 % 2]]
    cv2.fillPoly(label_map, [np.array([[0, 376], [500, 200], [740, 200], [1241, 376]])], ID["road"])
    for left in range(40, SIZE[1], 200):
        label_map[80:230, left : left + 6] = ID["pole"]
    label_map[190:260, 330:460] = label_map[190:290, 900:1060] = ID["car"]
    return label_map


STREET = street()
ROAD = np.where(ID["road"] == STREET, np.uint8(255), np.uint8(0))


def without_cars(margin=0):
    return keypoint_mask(STREET, SIZE, 1, MaskSettings(keep="static", movable=margin))


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize(
    "mask, fault",
    [
        (keypoint_mask(STREET, SIZE, 3), "boundaries left out"),
        (keypoint_mask(STREET, SIZE, 10), "boundaries left out"),
        (without_cars(), "things kept"),
        (without_cars(margin=15), "things kept"),
        (ROAD, UNKNOWN),
        (cv2.bitwise_not(np.where(ID["sky"] == STREET, np.uint8(255), np.uint8(0))), UNKNOWN),
    ],
)
def test_boundaries_and_things_tell_and_other_regions_do_not(mask, fault, inverted):
    expected = fault
    if not inverted and fault in INVERTED:
        expected = RIGHT
    if inverted:
        mask = cv2.bitwise_not(mask)
    assert polarity([mask, mask]) == expected
    assert polarity([mask // 255] * 2) == expected  # 0 and 1


def test_frames_without_things_do_not_count():
    everything = np.full(SIZE, 255, np.uint8)
    assert polarity([everything, without_cars(), everything]) == RIGHT
    nothing = cv2.bitwise_not(everything)
    assert polarity([nothing, cv2.bitwise_not(without_cars())]) == "things kept"
    assert polarity([everything]) == UNKNOWN


@pytest.mark.real
@pytest.mark.parametrize("drive", ["drive0005", "drive0095"])
def test_masks_of_real_streets(kitti_real, drive):
    paths = sorted((kitti_real.parent / "labels_espnetv2" / drive).glob("*.png"))[::9]
    label_maps = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    boundaries = [keypoint_mask(label_map, SIZE, 10) for label_map in label_maps]
    assert polarity(boundaries) == RIGHT
    assert polarity(map(cv2.bitwise_not, boundaries)) == "boundaries left out"
    road = [
        np.where(label_map == ID["road"], np.uint8(255), np.uint8(0)) for label_map in label_maps
    ]
    assert polarity(road) == polarity(map(cv2.bitwise_not, road)) == UNKNOWN
    things = [np.isin(label_map, MOVABLE).astype(np.uint8) for label_map in label_maps]
    assert polarity(things) == "things kept"
