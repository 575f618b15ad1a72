import albumentations
import numpy as np
import pytest

from thesis_repro.segmentation import augmentation

SIZE = 48
SEEDS = range(200)


@pytest.fixture(scope="module")
def pair():
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (SIZE, SIZE, 1), np.uint8)
    label = np.kron(random.integers(0, 34, (8, 8)), np.ones((6, 6))).astype(np.uint8)
    return image, label


def test_integer_label_maps_give_the_same_as_one_hot_masks(pair):
    image, label = pair
    integer = augmentation.training_augmenter(SIZE)
    one_hot = augmentation.Augmenter(augmentation.transform_list(SIZE, fill_mask=0))
    mask, outside = augmentation.one_hot(label, 35), 0
    for seed in SEEDS:
        image_a, label_a = integer(image, label, seed)
        image_b, mask_b = one_hot(image, mask, seed)
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
    spread = [
        augmentation.Augmenter([noise])(gray, gray[..., 0], seed)[0].std() for seed in range(40)
    ]

    # a variance of 10 to 50; today's default is a standard deviation of 51 to 112
    assert 2.7 < min(spread) < 4.0 and 6.0 < max(spread) < 7.3


def test_the_validation_set_is_only_blurred(pair):
    image, label = pair
    blurred, same_label = augmentation.validation_augmenter()(image, label, 0)

    assert np.array_equal(same_label, label)
    assert not np.array_equal(blurred, image)
    assert abs(blurred.mean() - image.mean()) < 2 and blurred.std() < image.std()


def test_a_set_is_augmented_once_image_by_image(pair):
    images, labels = (np.stack([array] * 3) for array in pair)
    augmenter = augmentation.training_augmenter(SIZE)
    a_images, a_labels = augmentation.augment_set(images, labels, augmenter, 5)
    b_images, _ = augmentation.augment_set(images[:2], labels[:2], augmenter, 5)

    assert a_images.shape == images.shape and a_labels.shape == labels.shape
    assert not np.array_equal(a_images[0], a_images[1])
    assert np.array_equal(a_images[:2], b_images)
