import albumentations
import numpy as np
import pytest

from thesis_repro.errors import InputError
from thesis_repro.segmentation import augmentation

SIZE = 48
SEEDS = range(80)


@pytest.fixture(scope="module")
def pair():
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (SIZE, SIZE, 1), np.uint8)
    label = np.kron(random.integers(0, 34, (8, 8)), np.ones((6, 6))).astype(np.uint8)
    return image, label


def test_integer_label_maps_give_the_same_as_one_hot_masks(pair):
    image, label = pair
    integer = augmentation.training_augmenter(SIZE)
    one_hot = albumentations.Compose(augmentation.transform_list(SIZE, fill_mask=0))
    mask, outside = augmentation.one_hot(label, 35), 0
    for seed in SEEDS:
        image_a, label_a = augmentation.augment(integer, image, label, seed)
        image_b, mask_b = augmentation.augment(one_hot, image, mask, seed)
        # the appendix ends with a Lambda that rounds and clips the masks
        assert np.array_equal(augmentation.one_hot(label_a, 35), mask_b.round().clip(0, 1)), (
            f"seed {seed}"
        )
        assert np.array_equal(image_a, image_b), f"seed {seed}"
        outside += (label_a == augmentation.NOTHING).any()
    assert outside > len(SEEDS) / 4  # otherwise the border fill is not tested


def test_noise_is_as_strong_as_in_the_thesis():
    gray = np.full((200, 200, 1), 128, np.uint8)
    noise = next(
        t for t in augmentation.transform_list(200) if isinstance(t, albumentations.GaussNoise)
    )
    noise.p = 1
    alone = albumentations.Compose([noise])
    noisy = [augmentation.augment(alone, gray, gray[..., 0], seed)[0] for seed in range(40)]
    spread = [image.std() for image in noisy]
    # a variance of 10 to 50; today's default is a standard deviation of 51 to 112
    assert 2.7 < min(spread) < 4.0 and 6.0 < max(spread) < 7.3


@pytest.mark.parametrize(
    "transform",
    [albumentations.Normalize(), albumentations.ToFloat(), albumentations.Resize(SIZE, SIZE // 2)],
)
def test_copies_of_another_type_or_size_are_refused(pair, transform):
    with pytest.raises(InputError, match="must stay uint8"):
        augmentation.augment(albumentations.Compose([transform]), *pair, 0)
