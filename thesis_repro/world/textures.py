"""The textures of the embedded world, painted once for a seed and packed for the rasteriser.

Painters return gray float32 (rows, columns), albedo 0 to 255; those of cut-outs also an alpha (0 to 255) of that shape.
Surfaces mix noise of many scales with structure, so that there are corners on them from near and from far.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.world.raster import ALPHA_LEVELS, LEVELS, OPAQUE, Textures

# Metres that one repeat covers (along u, along v); None: the whole width of what it lies on.
TILE = {"road": (28.0, None), "highway": (30.0, None), "asphalt": (12.0, 12.0), "sidewalk": (8.0, None),
        "grass": (12.0, 12.0), "roof": (6.0, 6.0), "stone": (6.0, 3.0), "leaves": (6.0, 6.0), "picket": (3.0, None),
        "facade": (12.0, 6.0), "metal": (2.0, 2.0)}
FACADES, TREES, PERSONS, SIGNS = 5, 4, 4, 3
# Side view of a car: metres from its rear and above the ground, from the front over the roof to the rear.
CAR_PROFILE = np.array([(4.3, 0.3), (4.3, 0.62), (4.1, 0.82), (3.15, 0.97), (2.45, 1.44), (0.6, 1.46), (0.1, 1.0),
                        (0.0, 0.62), (0.02, 0.3)])
CAR_HEIGHT = 1.5  # of the picture of its side


class Bank(NamedTuple):
    """The textures of a world: names to indices, and the arrays for `raster.render`."""

    names: dict
    packed: Textures


class _Packer:
    """Textures, each reduced along u and v separately.

    That keeps a road that is seen at a flat angle sharp across its markings without aliasing along them.
    """

    def __init__(self):
        self.names = {}
        self._chunks, self._length = [], 0
        self._gray, self._alpha, self._sides = [], [], []

    def add(self, name, gray, alpha=None):
        """Add a texture whose sides are powers of two."""
        self.names[name] = len(self.names)
        self._sides.append([side.bit_length() - 1 for side in gray.shape])
        self._gray.append(self._pack(gray, coverage=False))
        self._alpha.append(np.full((LEVELS, LEVELS), -1, np.int64) if alpha is None
                           else self._pack(alpha, coverage=True))

    def _pack(self, texture, coverage):
        """Store all levels of a texture; returns where each starts, (LEVELS, LEVELS), -1 where there is none."""
        offsets = np.full((LEVELS, LEVELS), -1, np.int64)
        covered = np.mean(texture >= OPAQUE)
        tall = texture.astype(np.float32)
        levels = ALPHA_LEVELS if coverage else LEVELS
        for row_level in range(min(levels, texture.shape[0].bit_length())):
            level = tall
            for column_level in range(min(levels, texture.shape[1].bit_length())):
                stored = level
                if coverage and 0 < covered < 1:
                    # Averaged leaves would fall below the opacity threshold and far trees would thin out.
                    stored = level * (OPAQUE / max(np.quantile(level, 1 - covered), 1.0))
                offsets[row_level, column_level] = self._length
                self._chunks.append(np.clip(np.rint(stored), 0, 255).astype(np.uint8).ravel())
                self._length += level.size
                if level.shape[1] > 1:
                    level = (level[:, 0::2] + level[:, 1::2]) * np.float32(0.5)
            if tall.shape[0] > 1:
                tall = (tall[0::2] + tall[1::2]) * np.float32(0.5)
        return offsets

    def bank(self):
        return Bank(self.names, Textures(np.concatenate(self._chunks), np.array(self._gray), np.array(self._alpha),
                                         np.array(self._sides, np.int64), self.names["clouds"], self.names["leaves"]))


@lru_cache(maxsize=1)
def build(seed):
    """All textures of the world with this seed, a `Bank`."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 7001]))
    packer = _Packer()
    packer.add("road", _carriageway(rng, ((0.04, 0.008, 0), (0.5, 0.008, 3), (0.96, 0.008, 0))))
    packer.add("highway", _carriageway(rng, ((0.05, 0.008, 0), (0.35, 0.005, 2), (0.65, 0.005, 2), (0.95, 0.008, 0))))
    packer.add("asphalt", _asphalt(rng, (512, 512), 6))
    sidewalk = 148 + _slabs(rng, (256, 512), 8, 16, 2) + 6 * noise(rng, (256, 512), 64, 5)
    sidewalk[-28:] = 168 + 8 * noise(rng, (32, 512), 16, 4)[-28:]  # the kerb, nearest to the road
    sidewalk[-28:, ::64], sidewalk[-30:-28] = 90, 100
    packer.add("sidewalk", sidewalk)
    packer.add("grass", 76 + 10 * noise(rng, (512, 512), 128, 3) + 9 * noise(rng, (512, 512), 8, 3)
               + 12 * _grain(rng, (512, 512)))
    packer.add("roof", 74 + _slabs(rng, (256, 256), 20, 16, 3) + 7 * noise(rng, (256, 256), 64, 4))
    packer.add("stone", 126 + _slabs(rng, (256, 512), 10, 10, 4, spread=17) + 8 * noise(rng, (256, 512), 32, 5))
    packer.add("metal", 92 + 7 * noise(rng, (128, 32), 16, 4) + np.linspace(35, -35, 32, dtype=np.float32))
    packer.add("picket", *_picket(rng))
    for kind in range(FACADES):
        packer.add(f"facade{kind}", _facade(rng, kind))
    leaves = _leaves(rng, (512, 512))
    packer.add("leaves", leaves)
    for kind in range(TREES):
        packer.add(f"tree{kind}", *_tree(rng, np.roll(leaves, 83 * kind, axis=1) * (1, 0.85, 1.1, 0.7)[kind]))
    for kind in range(PERSONS):
        packer.add(f"person{kind}", *_person(rng))
    for kind in range(SIGNS):
        front, alpha = _sign(kind)
        packer.add(f"sign{kind}", front, alpha)
        packer.add(f"back{kind}", 118 + 5 * noise(rng, front.shape, 32, 4), alpha)
    packer.add("paint", 128 + 1.5 * noise(rng, (64, 64), 32, 3) + np.linspace(12, -12, 64)[:, None])
    packer.add("glass", 60 + 3 * noise(rng, (64, 64), 32, 3) + np.linspace(40, -20, 64)[:, None])
    packer.add("front", _car_end(rng, lamp=225.0))
    packer.add("rear", _car_end(rng, lamp=62.0))
    packer.add("side", *_car_side(rng))
    packer.add("clouds", 128 + 60 * np.clip(noise(rng, (512, 1024), 128, 6, 0.55) - 0.2, 0, 2))
    return packer.bank()


# Noise


def noise(rng, shape, cell, octaves=4, persistence=0.6):
    """Periodic noise with unit deviation: octaves of smooth random grids, the first with `cell` pixels a knot.

    persistence: the weight of each octave relative to the one before, whose cell is twice as large. Sides and cell are
    powers of two.
    """
    rows, columns = max(1, shape[0] // cell), max(1, shape[1] // cell)
    total = rng.standard_normal((rows, columns), dtype=np.float32)
    weight = 1.0
    for _ in range(octaves - 1):
        rows, columns = min(2 * rows, shape[0]), min(2 * columns, shape[1])
        weight *= persistence
        total = _enlarged(total, (rows, columns)) + weight * rng.standard_normal((rows, columns), dtype=np.float32)
    total = _enlarged(total, shape)
    return total * np.float32(1 / max(float(total.std()), 1e-6))


def _enlarged(image, shape):
    """A periodic image resized smoothly by whole factors, periodic again."""
    if image.shape == tuple(shape):
        return image
    step_y, step_x = shape[0] // image.shape[0], shape[1] // image.shape[1]
    padded = np.pad(image, 2, mode="wrap")
    big = cv2.resize(padded, (padded.shape[1] * step_x, padded.shape[0] * step_y), interpolation=cv2.INTER_CUBIC)
    return big[2 * step_y:2 * step_y + shape[0], 2 * step_x:2 * step_x + shape[1]]


def _grain(rng, shape):
    """Periodic fine grain with unit deviation."""
    grain = np.pad(rng.standard_normal(shape, dtype=np.float32), 4, mode="wrap")
    grain = cv2.GaussianBlur(grain, (0, 0), 0.9)[4:-4, 4:-4]
    return grain / grain.std()


# Surfaces


def _asphalt(rng, shape, patches):
    """Asphalt with so many repaired squares and cracks."""
    rows, columns = shape
    base = 100.0
    image = base + 5 * noise(rng, shape, 128, 3) + 5 * noise(rng, shape, 16, 3) + 5 * _grain(rng, shape)
    for _ in range(patches):
        x, y = int(rng.integers(0, columns - 150)), int(rng.integers(0, rows - 120))
        width, height = int(rng.integers(40, 150)), int(rng.integers(30, 120))
        image[y:y + height, x:x + width] += rng.uniform(-16, 12)
        cv2.rectangle(image, (x, y), (x + width, y + height), base - 26, 2)
        crack = np.cumsum(rng.normal(0, 1, (30, 2)) * (9, 5), axis=0) + rng.uniform(0.1, 0.9, 2) * (columns, rows)
        cv2.polylines(image, [np.rint(crack).astype(np.int32)], False, base - 32, 1)
    for _ in range(patches // 4):
        manhole = (int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.2, 0.8) * rows))
        cv2.ellipse(image, manhole, (columns // 90, rows // 22), 0, 0, 360, base - 42, -1)
    return image


def _carriageway(rng, lines):
    """A road with its markings, (512, 2048), u along it; lines: (place, half width) in parts of its width, dashes."""
    image = _asphalt(rng, (512, 2048), 22)
    rows, columns = image.shape
    worn = noise(rng, image.shape, 16, 4) > 1.5
    for place, half, dashes in lines:
        line = np.zeros(image.shape, bool)
        for k in range(dashes or 1):
            start, length = (k * columns // dashes, columns // dashes // 2) if dashes else (0, columns)
            line[round((place - half) * rows):round((place + half) * rows), start:start + length] = True
        image[line & ~worn] = 208
    return image


def _slabs(rng, shape, rows, columns, joint, spread=9.0):
    """Slabs or bricks, to be added to a surface: a random tone for each (deviation `spread`), dark joints.

    rows, columns: of slabs in the shape; joint: pixels; every other row is shifted by half a slab.
    """
    height, width = shape
    y, x = np.mgrid[0:height, 0:width]
    row = y * rows // height
    shifted = (x + (row % 2) * (width // columns // 2)) % width
    column = shifted * columns // width
    image = (rng.standard_normal((rows, columns)).astype(np.float32) * spread)[row, column]
    image[(y - row * height // rows < joint) | (shifted - column * width // columns < joint)] = -2.2 * spread
    return image


def _facade(rng, kind):
    """Two floors of four bays of a house, (512, 1024); kind: below FACADES."""
    shape = (512, 1024)
    base = (172.0, 128.0, 200.0, 150.0, 112.0)[kind]
    width, height = ((92, 128), (84, 140), (120, 120), (100, 150), (150, 110))[kind]
    image = base + 14 * noise(rng, shape, 256, 4) + 4 * _grain(rng, shape)
    image += _slabs(rng, shape, 64, 64, 2) if kind in (1, 4) else _slabs(rng, shape, 16, 32, 2, spread=6)
    frame = 225.0 if base < 165 else 95.0
    for floor in range(2):
        for bay in range(4):
            # No two windows alike: in a turn, rows of equal ones are tracked to their neighbours.
            wide, high = int(width * rng.uniform(0.55, 1.2)), int(height * rng.uniform(0.7, 1.1))
            left = bay * 256 + 128 - wide // 2 + int(rng.integers(-36, 37))
            _window(rng, image, left, floor * 256 + 200 - high, wide, high, frame)
        image[floor * 256:floor * 256 + 12] = base + 26  # cornice
        image[floor * 256 + 12:floor * 256 + 20] *= 0.72
    stain = np.maximum(noise(rng, shape, 64, 4), 0) * np.linspace(0, 1, 512, dtype=np.float32)[:, None]
    return image - 14 * stain


def _window(rng, image, x, y, width, height, frame):
    """Paint one window into a facade: frame, sill, and glass with a curtain, a reflection or a blind."""
    cv2.rectangle(image, (x - 5, y - 5), (x + width + 5, y + height + 5), frame, -1)
    pane = np.tile(35 + 110 * rng.random() ** 2 + np.linspace(18, -12, height)[:, None], (1, width))
    content, depth = rng.random(), int(height * rng.uniform(0.3, 1.0))
    if content < 0.3:  # curtain
        pane[:depth] = 135 + 12 * np.sin(np.arange(width) * rng.uniform(0.4, 0.8))
    elif content < 0.6:  # reflected sky above the roofs opposite
        rows, columns = np.mgrid[0:height, 0:width]
        pane[rows < depth + rng.uniform(-0.4, 0.4) * (columns - width / 2)] += 55
    elif content < 0.8:  # roller blind
        pane[:depth] = 120 + 14 * (np.arange(depth)[:, None] % 7 < 2)
    image[y:y + height, x:x + width] = pane
    image[y:y + height, x + width // 2 - 2:x + width // 2 + 2] = frame
    cv2.rectangle(image, (x - 9, y + height + 4), (x + width + 9, y + height + 11), frame * 0.8 + 30, -1)  # sill
    image[y + height + 12:y + height + 16, x - 9:x + width + 9] *= 0.7


# Cut-outs


def _outline(shape, polygons, ellipses=()):
    """Antialiased alpha of polygons and ellipses given in parts of the size."""
    rows, columns = shape[0] * 2, shape[1] * 2
    mask = np.zeros((rows, columns), np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.rint(np.asarray(polygon, float) * (columns, rows)).astype(np.int32)], 255)
    for x, y, radius_x, radius_y in ellipses:
        cv2.ellipse(mask, (int(x * columns), int(y * rows)), (int(radius_x * columns), int(radius_y * rows)), 0, 0, 360,
                    255, -1)
    return cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def _leaves(rng, shape, dark=38, light=118, leaf=4):
    """Foliage in clumps: dark to light gray, leaves of that many pixels."""
    image = np.full(shape, float(dark), np.float32)
    clumps = noise(rng, shape, 64, 5, 0.75)
    rows, columns = shape
    count = rows * columns // (leaf * leaf * 2)
    x, y = rng.integers(0, columns, count), rng.integers(0, rows, count)
    angle, tone = rng.uniform(0, 180, count), np.sort(rng.random(count))
    for k in range(count):
        value = dark + (light - dark) * float(np.clip(0.6 * tone[k] + 0.22 * clumps[y[k], x[k]], 0, 1))
        cv2.ellipse(image, (int(x[k]), int(y[k])), (leaf, max(1, leaf // 2)), angle[k], 0, 360, value, -1)
    return image + 10 * clumps


def _tree(rng, leaves):
    """A tree in side view, (512, 512); leaves: what its crown shows."""
    shape = (512, 512)
    y, x = np.mgrid[0:512, 0:512].astype(np.float32)
    crown = 1.15 - ((x - 256) / 95) ** 2 - ((y - 205) / 120) ** 2  # around the trunk
    for _ in range(14):
        angle, reach = rng.uniform(0, 2 * np.pi), 130 * np.sqrt(rng.random())
        centre_x, centre_y = 256 + reach * 1.05 * np.cos(angle), 190 + reach * 0.95 * np.sin(angle)
        crown = np.maximum(crown, 1 - ((x - centre_x) ** 2 + (y - centre_y) ** 2) / rng.uniform(40, 80) ** 2)
    ragged = noise(rng, shape, 32, 5, 0.8)
    foliage = (np.clip(crown, 0, 1.3) + 0.22 * ragged > rng.uniform(0.3, 0.46)) & (crown > 0)
    bend, half = int(rng.integers(-12, 13)), int(rng.integers(7, 12))
    wood = np.zeros(shape, np.uint8)
    cv2.fillPoly(wood, [np.array([[256 - half, 512], [256 - half // 2 + bend, 150], [256 + half // 2 + bend, 150],
                                  [256 + half, 512]], np.int32)], 255)
    bark = 52 + 14 * noise(rng, shape, 16, 4) + np.linspace(-28, 28, 512, dtype=np.float32)
    image = np.where(foliage, leaves * (1.15 - 0.5 * (y - 30) / 320) * (0.9 + 0.12 * ragged), bark)
    alpha = np.where(foliage | (wood > 0), 255, 0).astype(np.float32)
    alpha[:4], alpha[:, :4], alpha[:, -4:] = 0, 0, 0
    return image, cv2.GaussianBlur(alpha, (0, 0), 0.8)


def _person(rng):
    """A standing or walking person, (256, 128) for 1.8 m by 0.9 m."""
    shape = (256, 128)
    stride, shoulder, hip = rng.uniform(0.03, 0.14), rng.uniform(0.15, 0.19), rng.uniform(0.11, 0.14)
    torso = [(0.5 - shoulder, 0.19), (0.5 + shoulder, 0.19), (0.5 + hip, 0.55), (0.5 - hip, 0.55)]
    legs = [[(0.5 + side * hip, 0.5), (0.5, 0.5), (0.5 + side * (stride - 0.05), 0.97),
             (0.5 + side * (stride + 0.06), 0.97)] for side in (-1, 1)]
    arms = [[(0.5 + side * shoulder, 0.2), (0.5 + side * (shoulder - 0.09), 0.22),
             (0.5 + side * (shoulder + 0.04), 0.52), (0.5 + side * (shoulder + 0.11), 0.5)] for side in (-1, 1)]
    neck, head = [(0.46, 0.14), (0.54, 0.14), (0.56, 0.2), (0.44, 0.2)], [(0.5, 0.093, 0.08, 0.06)]
    alpha = _outline(shape, [torso, neck, *legs, *arms], head)
    coat = rng.uniform(40, 190)
    image = np.full(shape, rng.uniform(42, 100), np.float32)  # trousers
    image[_outline(shape, arms) > 127] = 0.82 * coat
    image[_outline(shape, [torso]) > 127] = coat
    image[_outline(shape, [neck], head) > 127] = 118
    image[:int(0.08 * 256)] = rng.uniform(28, 80)  # hair
    image[int(0.945 * 256):] = 34  # shoes
    folds = noise(rng, (16, 128), 8, 2).repeat(16, axis=0)
    return image * np.linspace(1.16, 0.8, 128, dtype=np.float32) + 2.5 * folds, alpha


def _picket(rng):
    """A stretch of a picket fence, (128, 256)."""
    column = np.arange(256)[None] % 16
    bars = (128, 256)
    alpha = np.zeros(bars, np.float32)
    alpha[10:, column[0] < 9] = 255
    alpha[34:46], alpha[96:108] = 255, 255
    return (168 + 8 * noise(rng, bars, 32, 4) + 6 * _grain(rng, bars)) * np.where(column > 8, 0.7, 1.0), alpha


def _sign(kind):
    """The front of a traffic sign, (128, 128): speed limit, warning or direction board."""
    shape = (128, 128)
    image = np.full(shape, 232.0, np.float32)
    if kind == 0:
        alpha = _outline(shape, [], [(0.5, 0.5, 0.47, 0.47)])
        cv2.circle(image, (64, 64), 54, 95.0, 14)
        cv2.putText(image, "50", (28, 82), cv2.FONT_HERSHEY_SIMPLEX, 1.8, 25.0, 8)
    elif kind == 1:
        alpha = _outline(shape, [[(0.5, 0.04), (0.97, 0.93), (0.03, 0.93)]])
        cv2.polylines(image, [np.array([[64, 14], [114, 112], [14, 112]], np.int32)], True, 95.0, 14)
        cv2.line(image, (64, 50), (64, 96), 25.0, 9)
    else:
        alpha = _outline(shape, [[(0.02, 0.1), (0.98, 0.1), (0.98, 0.9), (0.02, 0.9)]])
        for row, length in ((34, 90), (64, 70), (94, 80)):
            for left in range(14, length, 11):
                cv2.rectangle(image, (left, row - 8), (left + 6, row + 6), 40.0, -1)
        cv2.rectangle(image, (3, 14), (124, 113), 60.0, 3)
    return image, alpha


def _car_side(rng):
    """A car of middle gray from the side, looking right, (256, 512)."""
    shape = (256, 512)
    length = CAR_PROFILE[:, 0].max()

    def parts(points):
        return np.asarray(points, float) * (1 / length, -1 / CAR_HEIGHT) + (0, 1)

    def wheels(share):
        return [(x / length, 1 - 0.31 / CAR_HEIGHT, share * 0.31 / length, share * 0.31 / CAR_HEIGHT)
                for x in (0.85, 3.45)]

    image = 128 + 1.5 * noise(rng, shape, 128, 3)
    # Doors bulge: above the crease they mirror the sky, below it the street.
    up = CAR_HEIGHT * (1 - np.arange(256, dtype=np.float32)[:, None] / 256)
    image *= np.interp(up, (0.2, 0.5, 0.62, 0.66, 0.9, 1.0, 1.5), (0.62, 0.8, 0.86, 1.12, 0.98, 1.2, 1.1))
    glass = _outline(shape, [parts([(0.35, 1.0), (1.5, 1.0), (1.5, 1.36), (0.7, 1.36)]),
                             parts([(1.6, 1.0), (2.9, 1.0), (2.35, 1.36), (1.6, 1.36)])]) > 127
    image[glass] = np.tile(np.linspace(125, 10, 256)[:, None], (1, 512))[glass]
    for door in (0.55, 1.55, 2.9):
        column = int(door / length * 512)
        cv2.line(image, (column, 88), (column, 205), 70.0, 2)
    cv2.line(image, (20, 170), (490, 170), 100.0, 2)
    image[112:130, -16:] = 170  # head lamp
    for share, gray in ((1.22, 22), (1.0, 34), (0.62, 150), (0.2, 60)):
        image[_outline(shape, [], wheels(share)) > 127] = gray
    return image, _outline(shape, [parts(CAR_PROFILE)], wheels(1.0))


def _car_end(rng, lamp):
    """Front or rear of a car of middle gray, (128, 256); lamp: the gray of its lamps."""
    image = 128 + 1.5 * noise(rng, (128, 256), 64, 3)
    image *= np.interp(np.arange(128), (0, 18, 22, 66, 90, 127), (1.18, 1.06, 0.94, 0.9, 1.02, 0.6))[:, None]
    for middle in (34, 222):
        cv2.ellipse(image, (middle, 44), (32, 15), 0, 0, 360, 60.0, -1)
        cv2.ellipse(image, (middle, 43), (27, 11), 0, 0, 360, lamp, -1)
    cv2.rectangle(image, (76, 36), (180, 60), 40.0, -1)
    cv2.line(image, (0, 96), (255, 96), 85.0, 2)
    cv2.rectangle(image, (92, 70), (164, 90), 190.0, -1)  # number plate
    for k in range(6):
        cv2.rectangle(image, (98 + 10 * k, 74), (103 + 10 * k, 86), 40.0, -1)
    return image
