"""The textures of the embedded world, painted once for a seed and packed for the rasteriser.

A painter returns a gray image (rows, columns), albedo 0 to 255. The painter of a cut-out also
returns an alpha image (0 to 255) of the same shape. Surfaces mix noise of many scales with
structure, so corners are found on them from near and from far. Windows and pickets differ from each
other: the tracker confuses equal ones with their neighbours.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from street_world.drives import TEXTURES
from street_world.raster import ALPHA_LEVELS, LEVELS, OPAQUE, Textures

# Metres that one repeat covers (along u, along v); None: one repeat covers the whole width of the
# surface.
TILE: dict[str, tuple[float, Any]] = {
    "road": (28.0, None),
    "highway": (30.0, None),
    "asphalt": (12.0, 12.0),
    "sidewalk": (8.0, None),
    "grass": (12.0, 12.0),
    "roof": (6.0, 6.0),
    "stone": (6.0, 3.0),
    "leaves": (6.0, 6.0),
    "picket": (6.0, None),
    "facade": (12.0, 6.0),
    "metal": (2.0, 2.0),
    "forest": (110.0, None),
    "sky": (600.0, 600.0),
}
FACADES, TREES, PERSONS, SIGNS = 4, 3, 3, 2
# Outline of a car in side view: (metres from the rear, metres above the ground), from the front
# over the roof.
CAR_PROFILE = np.array(
    [
        (4.3, 0.3),
        (4.3, 0.62),
        (4.1, 0.82),
        (3.15, 0.97),
        (2.45, 1.44),
        (0.6, 1.46),
        (0.1, 1.0),
        (0.0, 0.62),
        (0.02, 0.3),
    ]
)
CAR_HEIGHT = 1.5  # metres that the texture of the side covers


class Bank(NamedTuple):
    """The textures of a world."""

    names: dict  # name to index
    packed: Textures  # for `raster.render`


@lru_cache(maxsize=1)
def build(seed: int) -> Bank:
    """Return all textures of the world with this seed as a `Bank`."""
    painted = _painted(np.random.default_rng((seed, TEXTURES)))
    chunks: list[np.ndarray] = []
    start = np.zeros((len(painted), LEVELS, LEVELS), np.int64)
    length = 0
    sides = []
    for index, layers in enumerate(painted.values()):
        rows, columns = layers[0].shape
        sides.append([rows.bit_length() - 1, columns.bit_length() - 1])
        for j in range(rows.bit_length()):
            for i in range(columns.bit_length()):
                start[index, j, i] = length
                levels = [_reduced(layers[0], j, i)]
                if len(layers) > 1 and max(i, j) < ALPHA_LEVELS:  # coarser ones are never read
                    levels.append(_reduced(layers[1], j, i, is_alpha=True))
                chunks += levels
                length += sum(level.size for level in levels)
    names = {name: index for index, name in enumerate(painted)}
    cut_out = np.array([len(layers) > 1 for layers in painted.values()])
    packed = Textures(np.concatenate(chunks), start, np.array(sides, np.int64), cut_out)
    return Bank(names, packed)


def _reduced(
    layer: np.ndarray, row_level: int, column_level: int, is_alpha: bool = False
) -> np.ndarray:
    """Return one level of a gray or alpha image as a flat array of bytes.

    Rows and columns are reduced separately, so a road seen at a flat angle stays sharp in one
    direction without aliasing in the other.
    """
    rows, columns = layer.shape[0] >> row_level, layer.shape[1] >> column_level
    level = cv2.resize(layer, (columns, rows), interpolation=cv2.INTER_AREA)
    if is_alpha:
        # Averaging would push leaves below the opacity threshold, and distant trees would look
        # thin.
        threshold = np.quantile(level, 1 - np.mean(layer >= OPAQUE))
        level = level * (OPAQUE / max(threshold, 1.0))
    return np.clip(np.rint(level), 0, 255).astype(np.uint8).ravel()


def _painted(rng: np.random.Generator) -> dict[str, tuple[np.ndarray, ...]]:
    """Return all textures by name: (gray,), or (gray, alpha) for cut-outs.

    Their sides are powers of two.
    """
    big, middle, small = (512, 512), (256, 256), (64, 64)
    sidewalk = 148 + _slabs(rng, (256, 512), 8, 16, 2) + 9 * noise(rng, (256, 512), 64, 1.2)
    sidewalk[-28:] = 168 + 8 * noise(rng, (28, 512), 16)  # the kerb, nearest to the road
    sidewalk[-28:, ::64], sidewalk[-30:-28] = 90, 100
    leaves = _leaves(rng)
    ridge = 90 + 90 * noise(rng, (1, 512), 64)
    painted: dict[str, Any] = {
        "road": _carriageway(rng, ((0.04, 0.008, 0), (0.5, 0.008, 3), (0.96, 0.008, 0))),
        "highway": _carriageway(
            rng, ((0.05, 0.008, 0), (0.35, 0.005, 2), (0.65, 0.005, 2), (0.95, 0.008, 0))
        ),
        "asphalt": _asphalt(rng, big, 6),
        "sidewalk": sidewalk,
        "grass": 76 + 19 * noise(rng, big, 128, 0.9),
        "roof": 74 + _slabs(rng, middle, 20, 16, 3) + 7 * noise(rng, middle, 64),
        "stone": 126
        + _slabs(rng, (256, 512), 10, 10, 4, spread=17)
        + 8 * noise(rng, (256, 512), 32),
        "metal": 92 + 7 * noise(rng, (128, 32), 16) + np.linspace(35, -35, 32),
        "paint": 128 + 1.5 * noise(rng, small, 32) + np.linspace(12, -12, 64)[:, None],
        "glass": 60 + 3 * noise(rng, small, 32) + np.linspace(40, -20, 64)[:, None],
        "car end": _car_end(rng),
        "sky": 128 + 50 * np.clip(noise(rng, (1024, 1024), 128) - 0.2, 0, 2),
        "leaves": leaves,
        "forest": (leaves, np.where(np.arange(512)[:, None] > ridge, 255.0, 0.0)),
        "picket": _picket(rng),
        "car side": _car_side(rng),
        "sign0": _sign(0),
        "sign1": _sign(1),
    }
    for kind in range(FACADES):
        painted[f"facade{kind}"] = _facade(rng, kind)
    for kind, tone in enumerate((1, 0.8, 1.1)):
        painted[f"tree{kind}"] = _tree(rng, np.roll(leaves, 83 * kind, axis=1) * tone)
    for kind in range(PERSONS):
        painted[f"person{kind}"] = _person(rng)
    textures = {}
    for name, layers in painted.items():
        if not isinstance(layers, tuple):
            layers = (layers,)
        textures[name] = tuple(np.asarray(layer, np.float32) for layer in layers)
    return textures


# Surfaces


def noise(
    rng: np.random.Generator, shape: tuple[int, ...], cell: float, slope: float = 1.7
) -> np.ndarray:
    """Return periodic noise, float32, standard deviation 1.

    cell: size of the largest structures, about, in pixels. slope: how fast smaller structures fade;
    at 1 all sizes are equally strong.
    """
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1]))
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) / np.maximum(frequency, 0.5 / cell) ** slope
    spectrum[0, 0] = 0
    image = np.fft.irfft2(spectrum, shape)
    return (image / image.std()).astype(np.float32)


def _asphalt(rng: np.random.Generator, shape: tuple[int, ...], patches: int) -> np.ndarray:
    """Paint asphalt; patches: number of repaired squares and of cracks."""
    (rows, columns), base = shape, 100.0
    image = base + 9 * noise(rng, shape, 128, 0.9)
    for _ in range(patches):
        x, y = int(rng.integers(0, columns - 150)), int(rng.integers(0, rows - 120))
        width, height = int(rng.integers(40, 150)), int(rng.integers(30, 120))
        image[y : y + height, x : x + width] += rng.uniform(-16, 12)
        cv2.rectangle(image, (x, y), (x + width, y + height), base - 26, 2)
        crack = np.cumsum(rng.normal(0, 1, (30, 2)) * (9, 5), axis=0)
        crack += rng.uniform(0.1, 0.9, 2) * (columns, rows)
        cv2.polylines(image, [np.rint(crack).astype(np.int32)], False, base - 32, 1)
    return image


def _carriageway(rng: np.random.Generator, lines: Iterable[tuple[float, float, int]]) -> np.ndarray:
    """Paint a road with its markings, (512, 2048), u along the road.

    lines: (position, half width, number of dashes), the first two as shares of the road's width; 0
    dashes: solid.
    """
    image = _asphalt(rng, (512, 2048), 22)
    rows, columns = image.shape
    worn = noise(rng, image.shape, 16) > 1.5
    for place, half, dashes in lines:
        line = np.zeros(image.shape, bool)
        across = slice(round((place - half) * rows), round((place + half) * rows))
        if not dashes:
            line[across] = True
        for k in range(dashes):
            start = k * columns // dashes
            line[across, start : start + columns // dashes // 2] = True
        image[line & ~worn] = 208
    return image


def _slabs(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    rows: int,
    columns: int,
    joint: int,
    spread: float = 9.0,
) -> np.ndarray:
    """Paint slabs or bricks with dark joints, to be added to a surface.

    Each has a random tone (deviation `spread`). rows, columns: number of slabs; joint: pixels.
    Every second row is shifted by half a slab.
    """
    height, width = shape
    y, x = np.mgrid[0:height, 0:width]
    row = y * rows // height
    shifted = (x + (row % 2) * (width // columns // 2)) % width
    column = shifted * columns // width
    image = rng.normal(0, spread, (rows, columns))[row, column]
    above = y - row * height // rows < joint
    left = shifted - column * width // columns < joint
    image[above | left] = -2.2 * spread
    return image


def _facade(rng: np.random.Generator, kind: int) -> np.ndarray:
    """Paint two floors of a house with four windows each, (512, 1024); kind: 0 to FACADES - 1."""
    shape = (512, 1024)
    base = (172.0, 128.0, 200.0, 112.0)[kind]
    image = base + 17 * noise(rng, shape, 128, 1.2)
    if kind % 2:
        image += _slabs(rng, shape, 64, 64, 2)
    else:
        image += _slabs(rng, shape, 16, 32, 2, spread=6)
    frame = 95.0
    if base < 165:
        frame = 225.0
    for floor in range(2):
        for bay in range(4):
            width, height = int(rng.integers(60, 150)), int(rng.integers(85, 155))
            left = bay * 256 + 128 - width // 2 + int(rng.integers(-36, 37))
            top = floor * 256 + 200 - height
            corner = (left + width + 5, top + height + 5)
            cv2.rectangle(image, (left - 5, top - 5), corner, frame, -1)
            pane = image[top : top + height, left : left + width]
            pane[:] = 35 + 110 * rng.random() ** 2 + np.linspace(18, -12, height)[:, None]
            pane[: int(height * rng.uniform(0, 0.8))] = rng.uniform(90, 160)  # a blind
            pane[:, width // 2 - 2 : width // 2 + 2] = frame
        image[floor * 256 : floor * 256 + 12] = base + 26  # cornice
        image[floor * 256 + 12 : floor * 256 + 20] *= 0.72
    return image


# Cut-outs


def _outline(
    shape: tuple[int, ...],
    polygons: list,
    ellipses: Iterable[tuple[float, float, float, float]] = (),
) -> np.ndarray:
    """Return an antialiased alpha image of polygons and ellipses.

    Their coordinates are shares of the size. An ellipse: (x, y, radius along x, radius along y).
    """
    # reduced to `shape` at the end, which smooths the edges
    rows, columns = shape[0] * 2, shape[1] * 2
    mask = np.zeros((rows, columns), np.uint8)
    for polygon in polygons:
        corners = np.asarray(polygon, float) * (columns, rows)
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 255)
    for x, y, radius_x, radius_y in ellipses:
        centre = (int(x * columns), int(y * rows))
        radii = (int(radius_x * columns), int(radius_y * rows))
        cv2.ellipse(mask, centre, radii, 0, 0, 360, 255, -1)
    return cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def _leaves(rng: np.random.Generator) -> np.ndarray:
    """Paint foliage in clumps, (512, 512), the dark leaves first and the light ones over them."""
    image, count = np.full((512, 512), 38, np.float32), 8192
    clumps = noise(rng, image.shape, 64, 1.4)
    x, y = rng.integers(0, 512, (2, count))
    angle, tone = rng.uniform(0, 180, count), np.sort(rng.random(count))
    for k in range(count):
        lightness = np.clip(0.6 * tone[k] + 0.22 * clumps[y[k], x[k]], 0, 1)
        value = 38 + 80 * float(lightness)
        cv2.ellipse(image, (int(x[k]), int(y[k])), (4, 2), angle[k], 0, 360, value, -1)
    return image + 10 * clumps


def _tree(rng: np.random.Generator, leaves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Paint a tree in side view, (512, 512); leaves: texture of its crown."""
    shape = (512, 512)
    y, x = np.mgrid[0:512, 0:512]
    crown = 1.15 - ((x - 256) / 95) ** 2 - ((y - 205) / 120) ** 2  # around the trunk
    for centre_x, centre_y in rng.normal((256, 190), (85, 75), (14, 2)).clip(85, 427):
        squared = (x - centre_x) ** 2 + (y - centre_y) ** 2
        crown = np.maximum(crown, 1 - squared / rng.uniform(40, 80) ** 2)
    ragged = noise(rng, shape, 32, 1.4)
    foliage = np.clip(crown, 0, 1.3) + 0.22 * ragged > rng.uniform(0.3, 0.46) + 9 * (crown <= 0)
    half = int(rng.integers(7, 12))
    wood = (np.abs(x - 256) < half * (0.5 + y / 1024)) & (y > 150)
    bark = 52 + 14 * noise(rng, shape, 16) + np.linspace(-28, 28, 512)
    darker_below = 1.15 - 0.5 * (y - 30) / 320
    shaded = leaves * darker_below * (0.9 + 0.12 * ragged)
    return np.where(foliage, shaded, bark), np.where(foliage | wood, 255.0, 0.0)


def _person(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Paint a standing or walking person, (256, 128)."""
    shape = (256, 128)
    stride = rng.uniform(0.03, 0.14)
    shoulder = rng.uniform(0.17, 0.23)
    hip = rng.uniform(0.11, 0.14)
    torso = [
        (0.47, 0.15),
        (0.53, 0.15),
        (0.5 + shoulder, 0.2),
        (0.5 + shoulder, 0.5),
        (0.5 + hip, 0.55),
        (0.5 - hip, 0.55),
        (0.5 - shoulder, 0.5),
        (0.5 - shoulder, 0.2),
    ]
    legs = [
        [
            (0.5 + side * hip, 0.5),
            (0.5, 0.5),
            (0.5 + side * (stride - 0.05), 0.97),
            (0.5 + side * (stride + 0.06), 0.97),
        ]
        for side in (-1, 1)
    ]
    image = np.full(shape, rng.uniform(42, 100))  # trousers
    image[_outline(shape, [torso]) > 127] = rng.uniform(40, 190)
    image[:38], image[:20], image[242:] = 118, rng.uniform(28, 80), 34  # face, hair, shoes
    folds = noise(rng, shape, 8)
    head = (0.5, 0.093, 0.08, 0.06)
    alpha = _outline(shape, [torso, *legs], [head])
    return image * np.linspace(1.16, 0.8, 128) + 2.5 * folds, alpha


def _picket(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Paint a picket fence, (128, 512), with pickets of unequal width, height and tone."""
    image = 120 + 8 * noise(rng, (128, 512), 32, 1.2)
    alpha = np.zeros((128, 512))
    alpha[34:46] = alpha[96:108] = 255
    left = 0
    while left < 500:
        right = left + int(rng.integers(6, 16))
        alpha[rng.integers(2, 26) :, left:right] = 255
        image[:, left:right] += rng.uniform(10, 75)
        left = right + int(rng.integers(4, 12))
    return image, alpha


def _sign(kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Paint a traffic sign, (128, 128): "no entry" (kind 0) or a board.

    Both look the same from behind.
    """
    image = np.full((128, 128), 95.0)
    if kind == 0:
        cv2.rectangle(image, (26, 52), (101, 75), 232.0, -1)
        return image, _outline(image.shape, [], [(0.5, 0.5, 0.47, 0.47)])
    image[17:111, 6:122] = 232
    for row, half in ((34, 45), (64, 28), (94, 38)):
        for left in range(64 - half, 64 + half, 11):
            cv2.rectangle(image, (left, row - 8), (left + 6, row + 6), 40.0, -1)
    return image, _outline(image.shape, [[(0.02, 0.1), (0.98, 0.1), (0.98, 0.9), (0.02, 0.9)]])


def _car_side(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Paint the right side of a car in middle gray, (256, 512)."""
    shape, length = (256, 512), CAR_PROFILE[:, 0].max()

    def parts(points: np.ndarray | list) -> np.ndarray:
        return np.asarray(points, float) * (1 / length, -1 / CAR_HEIGHT) + (0, 1)

    def wheels(share: float) -> list[tuple[float, float, float, float]]:
        return [
            (x / length, 1 - 0.31 / CAR_HEIGHT, share * 0.31 / length, share * 0.31 / CAR_HEIGHT)
            for x in (0.85, 3.45)
        ]

    # A curved door reflects the sky above its crease and the street below it.
    up = CAR_HEIGHT * (1 - np.arange(256)[:, None] / 256)
    image = 128 + 1.5 * noise(rng, shape, 128)
    light = np.interp(up, (0.2, 0.5, 0.62, 0.66, 1.5), (0.6, 0.8, 0.85, 1.1, 1.1))
    image *= light.astype(np.float32)
    for left, right in ((0.7, 1.5), (1.6, 2.6)):
        corners = [(left - 0.2, 1.0), (right + 0.1, 1.0), (right - 0.1, 1.36), (left, 1.36)]
        window = _outline(shape, [parts(corners)])
        image[window > 127] = 50
    for door in (0.55, 1.55, 2.9):
        column = int(door / length * 512)
        cv2.line(image, (column, 88), (column, 205), 70.0, 2)
    for share, gray in ((1.22, 22), (1.0, 34), (0.62, 150), (0.2, 60)):
        image[_outline(shape, [], wheels(share)) > 127] = gray
    return image, _outline(shape, [parts(CAR_PROFILE)], wheels(1.0))


def _car_end(rng: np.random.Generator) -> np.ndarray:
    """Paint the front or rear of a car in middle gray, (128, 256)."""
    shade = np.linspace(20, -40, 128, dtype=np.float32)[:, None]
    image = 128 + 1.5 * noise(rng, (128, 256), 64) + shade
    for middle in (34, 222):
        cv2.ellipse(image, (middle, 44), (32, 15), 0, 0, 360, 60.0, -1)
        cv2.ellipse(image, (middle, 43), (27, 11), 0, 0, 360, 215.0, -1)
    cv2.rectangle(image, (76, 36), (180, 60), 40.0, -1)  # grille
    cv2.rectangle(image, (92, 70), (164, 90), 190.0, -1)  # number plate
    return image
