"""The augmentation of appendix A.3, applied to integer label maps."""

import warnings

import albumentations as A
import numpy as np

from thesis_repro.errors import InputError
from thesis_repro.running.files import progress

# a pixel without a class: one-hot encoding gives zeros, like the border in the appendix
NOTHING = 255

# The library's default noise at the time of the thesis: a variance of 10 to 50 grey levels squared.
# Today's default is about fifteen times as strong.
NOISE_STD = (10**0.5 / 255, 50**0.5 / 255)


def transform_list(size: int, fill_mask: int = NOTHING) -> list:
    """Return the transforms of A.3 for images of size x size, for `albumentations.Compose`.

    The appendix transforms one-hot masks of 35 float channels. All transforms resample masks by
    nearest neighbour, so integer label maps give the same labels with one byte a pixel instead of
    140. `fill_mask` is the value of pixels from outside the image: NOTHING in label maps, 0 in
    one-hot masks.
    """
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        # the library warns that this transform, which the thesis uses, is now called Affine
        shift_and_scale = A.ShiftScaleRotate(
            scale_limit=0.5,
            rotate_limit=0,
            shift_limit=0.1,
            p=1,
            border_mode=0,
            fill=0,
            fill_mask=fill_mask,
        )
    return [
        A.HorizontalFlip(p=0.5),
        shift_and_scale,
        A.PadIfNeeded(min_height=size, min_width=size, border_mode=0, fill=0, fill_mask=fill_mask),
        A.RandomCrop(height=size, width=size),
        A.GaussNoise(std_range=NOISE_STD, p=0.2),
        A.Perspective(p=0.5, fill=0, fill_mask=fill_mask),
        A.OneOf(
            [
                A.CLAHE(p=1),
                # the former RandomBrightness
                A.RandomBrightnessContrast(brightness_limit=0.2, contrast_limit=0, p=1),
                A.RandomGamma(p=1),
            ],
            p=0.9,
        ),
        A.OneOf(
            [
                A.Sharpen(p=1),
                A.Blur(blur_limit=3, p=1),
                A.MotionBlur(blur_limit=3, p=1),
            ],
            p=0.9,
        ),
    ]


def augment(
    transforms: A.Compose, image: np.ndarray, label: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Augment one image and its label map; the result depends only on these and on the seed.

    image: (height, width[, channels]) uint8. label: (height, width) uint8. Returns both in the same
    shapes. Use one `A.Compose` a thread.
    Raises InputError if the transforms return another type or another size (A.Normalize, A.ToFloat,
    A.Resize).
    """
    transforms.set_random_seed(int(seed))
    result = transforms(image=image, mask=label)
    augmented = result["image"]
    if augmented.dtype != np.uint8 or augmented.shape[:2] != image.shape[:2]:
        raise InputError(
            f"transforms: return {augmented.dtype} images of {augmented.shape[:2]}; they must stay uint8 "
            f"and {image.shape[:2]}, so leave out A.Normalize, A.ToFloat and A.Resize"
        )
    return augmented.reshape(image.shape), result["mask"]  # some drop a single channel


def training_augmenter(size: int) -> A.Compose:
    """Return the transforms of the training set, the appendix's list."""
    return A.Compose(transform_list(size))


def validation_augmenter() -> A.Compose:
    """Return the transforms of the validation set: only a blur, by a mistake in the appendix.

    Between the two sets, A.3 draws Figure 3.1, which leaves `transform` set to the last one drawn,
    the blur. Section 3.5.1 means `training_augmenter`.
    """
    return A.Compose([A.Blur(blur_limit=3, p=1)])


def augment_set(
    images: np.ndarray, labels: np.ndarray, transforms: A.Compose, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Augment every image of a set once (A.3).

    images: (n, size, size, channels) uint8. labels: (n, size, size) uint8. Returns new arrays of
    the same shapes. Each image has a seed that depends only on `seed` and its index.
    """
    augmented_images = np.empty_like(images)
    augmented_labels = np.empty_like(labels)
    for index in progress(range(len(images)), "augmenting", unit="image"):
        augmented_images[index], augmented_labels[index] = augment(
            transforms, images[index], labels[index], image_seed(seed, index)
        )
    return augmented_images, augmented_labels


def image_seed(seed: int, index: int) -> int:
    """Return the seed of one image, independent of the order in which images are augmented."""
    return int(np.random.SeedSequence((seed, 0, index)).generate_state(1)[0])


def one_hot(label_maps: np.ndarray, n_classes: int) -> np.ndarray:
    """Return label maps (..., height, width) one-hot encoded, float32 (..., n_classes).

    NOTHING becomes zeros.
    """
    is_class = label_maps[..., None] == np.arange(n_classes, dtype=np.uint8)
    return is_class.astype(np.float32)
