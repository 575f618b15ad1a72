"""Painted textures of the embedded world: asphalt, facades, leaves, vehicles, persons, signs and sky.

Each painter returns gray float32 (rows, columns) of albedo 0 to 255, some also an alpha of the same size. Every surface
mixes noise of many scales with structure, so that corners are found on it from near and from far.
"""

from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.render import Textures

# Metres that one repeat of a tiled texture covers (along u, along v).
TILE = {
    "road": (7.0, 28.0), "lane": (7.0, 28.0), "highway": (15.0, 30.0), "parking": (2.3, 11.0), "asphalt": (12.0, 12.0),
    "sidewalk": (4.0, 8.0), "kerb": (0.3, 8.0), "grass": (12.0, 12.0), "gravel": (8.0, 8.0), "roof": (6.0, 6.0),
    "stone": (6.0, 3.0), "hedge": (4.0, 4.0), "wood": (4.0, 2.0), "picket": (3.0, 1.2), "wire": (4.0, 1.8),
    "rail": (4.0, 0.8), "concrete": (8.0, 8.0),
}
FACADES = 8
FACADE_TILE = (12.0, 6.0)  # four bays by two floors
SHOP_TILE = (12.0, 3.5)
TREES, PERSONS, CARS, SIGNS = 6, 6, 6, 6


def noise(rng, shape, cell, octaves=4, persistence=0.6):
    """Periodic noise with unit deviation: octaves of smooth random grids, the first with `cell` pixels a knot."""
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


def _speckle(rng, shape, sigma=1.0):
    grain = rng.standard_normal(shape, dtype=np.float32)
    grain = cv2.GaussianBlur(np.pad(grain, 4, mode="wrap"), (0, 0), sigma)[4:-4, 4:-4] if sigma else grain
    return grain / grain.std()


def _asphalt(rng, shape, base, patches):
    rows, columns = shape
    image = base + 5 * noise(rng, shape, 128, 3) + 5 * noise(rng, shape, 16, 3) + 5 * _speckle(rng, shape, 0.8)
    for _ in range(patches):  # repaired squares with dark tar seams
        x, y = rng.integers(0, columns - 40), rng.integers(0, rows - 60)
        w, h = rng.integers(30, max(31, columns // 3)), rng.integers(40, max(41, rows // 8))
        image[y:y + h, x:x + w] += rng.uniform(-16, 12)
        cv2.rectangle(image, (int(x), int(y)), (int(min(x + w, columns - 1)), int(min(y + h, rows - 1))),
                      float(base - 26), 2)
    for _ in range(patches):  # cracks
        points = np.cumsum(rng.normal(0, 1, (30, 2)) * (5, 9) + rng.normal(0, 1, 2) * (2, 5), axis=0)
        points += (rng.uniform(0.1, 0.9) * columns, rng.uniform(0.1, 0.9) * rows)
        cv2.polylines(image, [np.rint(points).astype(np.int32)], False, float(base - 32), 1)
    for _ in range(max(1, patches // 4)):  # manholes and drains
        x, y = rng.uniform(0.2, 0.8) * columns, rng.uniform(0.1, 0.9) * rows
        size = (int(0.3 / 7 * columns) + 2, int(0.3 / 28 * rows) + 2)
        cv2.ellipse(image, (int(x), int(y)), size, 0, 0, 360, float(base - 42), -1)
        cv2.ellipse(image, (int(x), int(y)), (size[0] - 2, size[1] - 2), 0, 0, 360, float(base - 15), 1)
    return image


def _marking(rng, image, x0, x1, dashes, value=205.0):
    """Paint worn lane markings between two columns (parts of the width), dashed or full."""
    rows, columns = image.shape
    line = np.zeros(image.shape, bool)
    left, right = int(round(x0 * columns)), max(int(round(x1 * columns)), int(round(x0 * columns)) + 1)
    for k in range(dashes or 1):
        top, length = (k * rows // dashes, rows // dashes // 2) if dashes else (0, rows)
        line[top:top + length, left:right] = True
    worn = noise(rng, image.shape, 16, 4) > 1.5
    image[line & ~worn] = value + 8 * _speckle(rng, image.shape)[line & ~worn]


def _road(rng):
    image = _asphalt(rng, (2048, 512), 98, 22)
    column = np.linspace(-1, 1, 512, dtype=np.float32)
    image += 5 * np.cos(column * 3 * np.pi)[None]  # wheel tracks
    return image


def _tiles(rng, shape, rows, columns, joint, offset=True, spread=9.0):
    """Slabs or bricks: a random tone for each, dark joints."""
    height, width = shape
    y, x = np.mgrid[0:height, 0:width]
    row = y * rows // height
    shifted = (x + (row % 2) * (width // columns // 2 if offset else 0)) % width
    column = shifted * columns // width
    tone = rng.standard_normal((rows, columns)).astype(np.float32) * spread
    image = tone[row, column]
    in_row, in_column = y - row * height // rows, shifted - column * width // columns
    image[(in_row < joint) | (in_column < joint)] = -2.2 * spread
    return image


def _window(rng, image, x, y, w, h, frame, style):
    """One window: frame, sill, glass with reflections or a curtain."""
    cv2.rectangle(image, (x - 5, y - 5), (x + w + 5, y + h + 5), frame, -1)
    glass = 45 + 25 * rng.random() + np.linspace(18, -12, h, dtype=np.float32)[:, None]
    pane = np.repeat(glass, w, axis=1) + 7 * noise(rng, (64, 64), 16, 3)[:1, :1]
    if rng.random() < 0.35:  # curtain
        depth = int(h * rng.uniform(0.3, 1.0))
        folds = 12 * np.sin(np.arange(w, dtype=np.float32) * rng.uniform(0.4, 0.8))
        pane[:depth] = 135 + folds[None]
    elif rng.random() < 0.4:  # reflected sky and opposite roofs
        edge = rng.integers(h // 4, h)
        slope = rng.uniform(-0.4, 0.4)
        yy, xx = np.mgrid[0:h, 0:w]
        pane[yy < edge + slope * (xx - w / 2)] += 55
    image[y:y + h, x:x + w] = pane
    if style != 2:
        image[y:y + h, x + w // 2 - 2:x + w // 2 + 2] = frame
    if style == 1:
        image[y + h // 3:y + h // 3 + 3, x:x + w] = frame
    if rng.random() < 0.3:  # roller blind
        depth = int(h * rng.uniform(0.15, 0.7))
        image[y:y + depth, x:x + w] = 120 + 14 * (np.arange(depth)[:, None] % 7 < 2)
    cv2.rectangle(image, (x - 9, y + h + 4), (x + w + 9, y + h + 11), frame * 0.8 + 30, -1)  # sill
    image[y + h + 12:y + h + 16, x - 9:x + w + 9] *= 0.7
    image[y - 5:y, x - 5:x + w + 5] *= 0.75  # the lintel's shadow


def _facade(rng, kind):
    shape = (512, 1024)
    base = (172, 128, 200, 150, 112, 186, 142, 160)[kind]
    image = base + 6 * noise(rng, shape, 256, 4) + 4 * _speckle(rng, shape)
    if kind in (1, 4):
        image += _tiles(rng, shape, 64, 64, 2)
    elif kind in (3, 6):
        image += _tiles(rng, shape, 8, 8, 3, offset=False, spread=5)
    frame = 225.0 if base < 165 else 95.0
    style = kind % 3
    for floor in range(2):
        top = floor * 256
        if kind == 6:  # ribbon windows
            for bay in range(8):
                _window(rng, image, bay * 128 + 7, top + 70, 112, 120, 60.0, 2)
            continue
        for bay in range(4):
            width = (92, 84, 120, 100, 76, 108, 0, 130)[kind]
            height = (128, 140, 120, 150, 136, 118, 0, 110)[kind]
            x = bay * 256 + 128 - width // 2 + int(rng.integers(-4, 5))
            _window(rng, image, x, top + 70, width, height, frame, style)
            if kind == 7 and bay % 2 == floor:  # balcony
                cv2.rectangle(image, (x - 50, top + 150), (x + width + 50, top + 205), base * 0.62, -1)
                for bar in range(x - 46, x + width + 50, 9):
                    image[top + 154:top + 200, bar:bar + 4] = base * 0.95
                image[top + 205:top + 225, x - 50:x + width + 50] *= 0.6
            if kind == 5:  # shutters
                for side in (x - 38, x + width + 8):
                    image[top + 68:top + 72 + height, side:side + 30] = 78 + 16 * (
                        np.arange(4 + height)[:, None] % 8 < 4)
        if kind in (0, 2, 4):  # cornice
            image[top + 2:top + 14] = base + 28
            image[top + 14:top + 22] *= 0.72
    stain = np.maximum(noise(rng, shape, 64, 4), 0) * np.linspace(0, 1, 512, dtype=np.float32)[:, None]
    return image - 7 * stain


def _shop(rng, kind):
    """A ground floor: doors, shop windows or a plinth with small windows."""
    shape = (256, 1024)
    base = (150, 118, 176, 132)[kind % 4]
    image = base + 6 * noise(rng, shape, 128, 4) + 4 * _speckle(rng, shape)
    image += _tiles(rng, shape, 8, 16, 2, spread=5)
    image[215:] *= 0.72  # plinth
    for bay in range(4):
        x = bay * 256 + 28
        what = rng.integers(0, 4)
        if what == 0:  # shop window with a sign above
            cv2.rectangle(image, (x, 60), (x + 200, 215), 58.0, -1)
            for _ in range(14):
                px, py = int(rng.integers(x + 5, x + 180)), int(rng.integers(110, 200))
                cv2.rectangle(image, (px, py), (px + int(rng.integers(6, 30)), 213), float(rng.uniform(70, 200)), -1)
            cv2.rectangle(image, (x - 8, 14), (x + 208, 50), float(rng.choice([60.0, 225.0])), -1)
            for k in range(7):
                left = x + 14 + k * 26
                cv2.rectangle(image, (left, 22), (left + 14, 42), float(rng.choice([120.0, 160.0])), -1)
        elif what == 1:  # door
            cv2.rectangle(image, (x + 60, 40), (x + 140, 254), 205.0, -1)
            cv2.rectangle(image, (x + 66, 46), (x + 134, 254), 62.0, -1)
            cv2.rectangle(image, (x + 76, 60), (x + 124, 130), 92.0, -1)
            cv2.rectangle(image, (x + 76, 150), (x + 124, 235), 80.0, -1)
            cv2.circle(image, (x + 128, 150), 4, 220.0, -1)
        elif what == 2:  # garage
            cv2.rectangle(image, (x + 4, 60), (x + 196, 254), 190.0, -1)
            image[64:254, x + 8:x + 192] = 165 - 25 * (np.arange(190)[:, None] % 19 < 3)
        else:
            _window(rng, image, x + 40, 70, 100, 110, 215.0, 1)
    image[:8] *= 0.7
    return image


def _outline(shape, polygons, ellipses=(), scale=2):
    """Antialiased alpha of polygons and ellipses given in parts of the size."""
    rows, columns = shape[0] * scale, shape[1] * scale
    mask = np.zeros((rows, columns), np.uint8)
    for polygon in polygons:
        points = np.rint(np.asarray(polygon, float) * (columns, rows)).astype(np.int32)
        cv2.fillPoly(mask, [points], 255)
    for x, y, rx, ry in ellipses:
        cv2.ellipse(mask, (int(x * columns), int(y * rows)), (int(rx * columns), int(ry * rows)), 0, 0, 360, 255, -1)
    return cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def _leaves(rng, shape, dark=38, light=118, leaf=4):
    image = np.full(shape, float(dark), np.float32)
    clumps = noise(rng, shape, 64, 5, 0.75)
    rows, columns = shape
    count = rows * columns // (leaf * leaf * 2)
    x, y = rng.integers(0, columns, count), rng.integers(0, rows, count)
    angle, tone = rng.uniform(0, 180, count), rng.random(count)
    order = np.argsort(tone, kind="stable")
    for k in order:
        value = dark + (light - dark) * float(np.clip(0.6 * tone[k] + 0.22 * clumps[y[k], x[k]], 0, 1))
        cv2.ellipse(image, (int(x[k]), int(y[k])), (leaf, max(1, leaf // 2)), angle[k], 0, 360, value, -1)
    return image + 10 * clumps


def _tree(rng, kind, leaves):
    shape = (512, 512)
    crown = np.zeros(shape, np.float32)
    y, x = np.mgrid[0:512, 0:512].astype(np.float32)
    if kind < 4:
        for _ in range(16 if kind != 3 else 9):
            angle, reach = rng.uniform(0, 2 * np.pi), 130 * np.sqrt(rng.random())
            cx, cy = 256 + reach * np.cos(angle) * 1.05, 190 + reach * np.sin(angle) * (0.95, 0.8, 1.0, 1.0)[kind]
            radius = rng.uniform(45, 85) * (1, 1, 0.9, 0.75)[kind]
            crown = np.maximum(crown, 1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius ** 2)
        threshold = (0.35, 0.42, 0.5, 0.62)[kind]
        top, bottom = 30, 350
    else:  # conifer
        crown = 1.2 - np.abs(x - 256) / (20 + (y - 10) * 0.42) - np.maximum(0, y - 440) * 0.1
        crown[y < 14] = 0
        crown += 0.15 * np.sin(y / 9)
        crown[np.abs(x - 256) > 40 + 0.42 * y] = 0
        threshold = 0.45
        top, bottom = 10, 450
    ragged = noise(rng, shape, 32, 5, 0.8)
    body = np.clip(crown, 0, 1.3) + 0.28 * ragged
    mask = (body > threshold) & (crown > 0)
    image = leaves * (1.15 - 0.5 * (y - top) / (bottom - top)) * (0.9 + 0.12 * ragged)
    trunk = np.zeros(shape, np.uint8)
    bend = int(rng.integers(-12, 13))
    half = (11, 8, 9, 7, 9, 9)[kind]
    cv2.fillPoly(trunk, [np.array([[256 - half, 512], [256 - half // 2 + bend, 150], [256 + half // 2 + bend, 150],
                                   [256 + half, 512]], np.int32)], 255)
    if kind < 4:
        for _ in range(7):
            y0 = int(rng.integers(240, 330))
            end = (256 + int(rng.integers(-110, 110)), y0 - int(rng.integers(60, 140)))
            cv2.line(trunk, (256 + bend // 2, y0), end, 255, int(rng.integers(3, 7)))
        trunk[(crown < 0.15) & (y < 350)] = 0  # no branch sticks out of the crown
    bark = 52 + 14 * noise(rng, shape, 16, 4) + np.linspace(-14, 14, 512, dtype=np.float32)[None] * 2
    wood = (trunk > 0) & ~mask
    image[wood] = bark[wood]
    alpha = np.where(mask | (trunk > 0), 255, 0).astype(np.float32)
    alpha[:4], alpha[:, :4], alpha[:, -4:] = 0, 0, 0
    return image, cv2.GaussianBlur(alpha, (0, 0), 0.8)


def _person(rng, kind):
    """A standing or walking person in front or side view, 0.9 m by 1.8 m."""
    shape = (256, 128)
    stride = rng.uniform(0.03, 0.14)
    shoulder = rng.uniform(0.15, 0.19)
    hip = rng.uniform(0.11, 0.14)
    torso = [(0.5 - shoulder, 0.19), (0.5 + shoulder, 0.19), (0.5 + hip, 0.52), (0.5 - hip, 0.52)]
    if kind % 3 == 2:  # coat
        torso[2], torso[3] = (0.5 + hip * 1.4, 0.66), (0.5 - hip * 1.4, 0.66)
    legs = [[(0.5 - hip, 0.5), (0.5, 0.5), (0.49 - stride + 0.05, 0.97), (0.49 - stride - 0.06, 0.97)],
            [(0.5, 0.5), (0.5 + hip, 0.5), (0.51 + stride + 0.06, 0.97), (0.51 + stride - 0.05, 0.97)]]
    arms = [[(0.5 - shoulder, 0.2), (0.5 - shoulder + 0.09, 0.22), (0.46 - shoulder, 0.52), (0.39 - shoulder, 0.5)],
            [(0.5 + shoulder, 0.2), (0.5 + shoulder - 0.09, 0.22), (0.54 + shoulder, 0.52), (0.61 + shoulder, 0.5)]]
    head = [(0.5, 0.105, 0.085, 0.075)]
    alpha = _outline(shape, [torso, *legs, *arms, [(0.46, 0.14), (0.54, 0.14), (0.55, 0.2), (0.45, 0.2)]], head)
    coat, trousers = float(rng.uniform(25, 190)), float(rng.uniform(20, 95))
    image = np.full(shape, trousers, np.float32)
    image[:int(0.53 * 256)] = coat
    if kind % 3 == 2:
        image[:int(0.66 * 256)] = coat
    upper = _outline(shape, arms) > 127
    image[upper] = coat * 0.85 + 8
    image[_outline(shape, [], head) > 127] = 152
    image[:int(0.085 * 256)] = rng.uniform(25, 90)  # hair
    image[int(0.945 * 256):] = 30
    if kind % 2:  # bag or stripes
        cv2.rectangle(image, (70, 60), (92, 110), float(rng.choice([35.0, 205.0])), -1)
    image += 7 * noise(rng, shape, 16, 4) + np.linspace(10, -10, 128, dtype=np.float32)[None]
    return image, alpha


def _bicycle(rng):
    shape = (128, 256)
    mask = np.zeros((512, 1024), np.uint8)
    for x in (190, 834):
        cv2.circle(mask, (x, 330), 160, 255, 20)
        for k in range(6):
            a = k * np.pi / 6
            d = (int(150 * np.cos(a)), int(150 * np.sin(a)))
            cv2.line(mask, (x - d[0], 330 - d[1]), (x + d[0], 330 + d[1]), 255, 5)
    for line in (((190, 330), (370, 110)), ((370, 110), (720, 110)), ((720, 110), (470, 340)), ((470, 340), (190, 330)),
                 ((370, 110), (470, 340)), ((834, 330), (710, 50)), ((710, 50), (780, 40)), ((330, 70), (430, 70)),
                 ((350, 60), (370, 110))):
        cv2.line(mask, *line, 255, 24)
    cv2.circle(mask, (470, 340), 45, 255, -1)
    mask[490:] = 0
    return 48 + 12 * noise(rng, shape, 16, 4), cv2.resize(mask, (256, 128), interpolation=cv2.INTER_AREA)


def _rider(rng):
    """The upper part of a cyclist from the side, to sit on the bicycle texture."""
    shape = (256, 256)
    polygons = [[(0.34, 0.52), (0.46, 0.52), (0.66, 0.18), (0.5, 0.13)],  # back
                [(0.56, 0.2), (0.64, 0.2), (0.76, 0.42), (0.7, 0.45)],  # arm
                [(0.34, 0.5), (0.47, 0.5), (0.6, 0.7), (0.5, 0.74)],  # thigh and leg
                [(0.5, 0.68), (0.6, 0.69), (0.52, 0.97), (0.44, 0.97)]]
    head = [(0.64, 0.1, 0.07, 0.085)]
    alpha = _outline(shape, polygons, head)
    image = np.full(shape, 60.0, np.float32)
    image[:130] = rng.uniform(110, 200)
    image[_outline(shape, [], head) > 127] = 150
    image[:22] = 215
    return image + 7 * noise(rng, shape, 16, 4), alpha


# Side views: (x, y) in metres from the rear bumper on the ground up; the order runs from front to rear over the roof.
PROFILES = {
    "sedan": [(4.5, 0.3), (4.5, 0.62), (4.3, 0.78), (3.25, 0.95), (2.5, 1.42), (1.35, 1.44), (0.7, 1.03), (0.05, 0.98),
              (0.0, 0.6), (0.02, 0.3)],
    "hatch": [(4.0, 0.3), (4.0, 0.64), (3.8, 0.84), (3.0, 1.0), (2.3, 1.46), (0.75, 1.46), (0.15, 1.0), (0.0, 0.65),
              (0.02, 0.3)],
    "estate": [(4.6, 0.3), (4.6, 0.64), (4.4, 0.82), (3.35, 0.98), (2.6, 1.46), (0.45, 1.46), (0.05, 0.98), (0.0, 0.6),
               (0.02, 0.3)],
    "van": [(4.9, 0.35), (4.9, 0.8), (4.7, 1.05), (4.1, 1.2), (3.5, 1.95), (0.1, 1.98), (0.0, 1.1), (0.0, 0.35)],
    "truck": [(7.5, 0.4), (7.5, 1.2), (7.4, 1.6), (7.2, 2.6), (6.1, 2.65), (5.9, 2.65), (5.85, 3.1), (0.0, 3.1),
              (0.0, 0.4)],
    "bus": [(11.0, 0.35), (11.0, 1.1), (10.95, 1.2), (10.85, 2.8), (10.5, 3.0), (0.2, 3.0), (0.0, 2.6), (0.0, 0.35)],
}
WIDTHS = {"sedan": 1.75, "hatch": 1.68, "estate": 1.78, "van": 1.92, "truck": 2.3, "bus": 2.5}
_WHEELS = {"sedan": (0.85, 3.6, 0.31), "hatch": (0.75, 3.2, 0.3), "estate": (0.9, 3.7, 0.31), "van": (0.95, 3.95, 0.34),
           "truck": (1.5, 6.4, 0.48), "bus": (2.6, 8.4, 0.5)}


def _side(rng, kind, paint):
    profile = np.array(PROFILES[kind])
    length, height = profile[:, 0].max(), profile[:, 1].max() + 0.04
    shape = (256, 512)
    scale = np.array([1 / length, 1 / height])

    def parts(points):
        points = np.asarray(points, float) * scale
        return np.stack([points[:, 0], 1 - points[:, 1]], axis=1)

    rear, front, radius = _WHEELS[kind]
    wheels = [(x / length, 1 - radius / height, radius / length, radius / height) for x in (rear, front)]
    arches = [(x, y, rx * 1.22, ry * 1.22) for x, y, rx, ry in wheels]
    alpha = _outline(shape, [parts(profile)], wheels)
    image = paint + 4 * noise(rng, shape, 64, 5)
    image += np.linspace(22, -26, 256, dtype=np.float32)[:, None]
    top = profile[:, 1].max()
    roof = profile[profile[:, 1] > top - 0.1, 0]
    if kind in ("truck", "bus"):
        panes = []
        if kind == "bus":
            panes = [[(x, 1.3), (x + 1.25, 1.3), (x + 1.25, 2.5), (x, 2.5)] for x in np.arange(0.5, 10.2, 1.4)]
            cv2.line(image, (0, 190), (511, 190), float(255 - paint), 10)
        else:
            panes = [[(6.5, 1.6), (7.15, 1.6), (7.05, 2.4), (6.5, 2.4)]]
            image[:, :int(5.8 / length * 512)] = paint + 30 + 5 * noise(rng, shape, 32, 4)[:, :int(5.8 / length * 512)]
            image[185:, :int(5.8 / length * 512)] = 48
            cv2.rectangle(image, (60, 50), (330, 120), float(200 - 0.5 * paint), -1)
    else:
        belt = 0.96 if kind != "van" else 1.2
        back, ahead = roof.min(), roof.max()
        sill = belt + 0.02
        foot_front = 3.15 if kind == "sedan" else (2.9 if kind == "hatch" else (3.25 if kind == "estate" else 4.0))
        foot_rear = {"sedan": 0.95, "hatch": 0.35, "estate": 0.3, "van": 2.3}[kind]
        pillar = (back + ahead) / 2 + 0.15
        top -= 0.1
        rear_top = back + 0.1 if kind != "van" else 2.4
        panes = [[(foot_rear, sill), (pillar - 0.05, sill), (pillar - 0.05, top), (rear_top, top)],
                 [(pillar + 0.05, sill), (foot_front - 0.15, sill), (ahead - 0.08, top), (pillar + 0.05, top)]]
    for pane in panes:
        glass = _outline(shape, [parts(pane)]) > 127
        tone = 48 + 22 * noise(rng, shape, 128, 3)
        image[glass] = np.clip(tone, 18, 120)[glass]
    if kind not in ("truck", "bus"):
        for x in (foot_rear + 0.15, pillar, foot_front + 0.05):  # door gaps and handles
            column = int(x / length * 512)
            cv2.line(image, (column, 95), (column, 205), paint * 0.55, 2)
            cv2.rectangle(image, (column - 26, 118), (column - 10, 122), paint * 0.6, -1)
        cv2.line(image, (20, 170), (490, 170), paint * 0.8, 2)
        image[120:138, -16:] = 225
        image[110:132, :14] = 95
    image[_outline(shape, [], arches) > 127] = 22
    image[_outline(shape, [], wheels) > 127] = 34
    rims = [(x, y, rx * 0.62, ry * 0.62) for x, y, rx, ry in wheels]
    image[_outline(shape, [], rims) > 127] = 165
    spokes = 2 * np.pi * np.arange(5) / 5 + 0.3
    holes = [(x + 0.38 * rx * np.cos(a), y + 0.38 * ry * np.sin(a), rx * 0.12, ry * 0.14)
             for x, y, rx, ry in wheels for a in spokes]
    image[_outline(shape, [], holes) > 127] = 60
    return image, alpha


def _end(rng, paint, front, tall=False):
    """Front or rear of a vehicle, from the bumper to the beltline."""
    shape = (128, 256)
    image = paint + 4 * noise(rng, shape, 32, 4) + np.linspace(14, -18, 128, dtype=np.float32)[:, None]
    image[92:] = paint * 0.5 + 10
    for left in (8, 198):
        cv2.rectangle(image, (left, 28), (left + 50, 62), 235.0 if front else 70.0, -1)
        cv2.rectangle(image, (left + 12, 36), (left + 32, 54), 180.0 if front else 120.0, -1)
    if front:
        image[34:66, 70:186] = 40 + 45 * (np.arange(32)[:, None] % 8 < 3)
    else:
        cv2.line(image, (0, 20), (255, 20), paint * 0.6, 2)
    cv2.rectangle(image, (92, 70), (164, 90), 225.0, -1)
    for k in range(6):
        cv2.rectangle(image, (98 + 10 * k, 74), (103 + 10 * k, 86), 40.0, -1)
    return image


def _glass(rng):
    image = 62 + 14 * noise(rng, (128, 128), 64, 4) + np.linspace(55, -25, 128, dtype=np.float32)[:, None]
    image[:6], image[-6:], image[:, :6], image[:, -6:] = 30, 30, 30, 30
    cv2.rectangle(image, (22, 80), (48, 122), 35.0, -1)  # seats seen through it
    cv2.rectangle(image, (80, 80), (106, 122), 35.0, -1)
    return image


def _sign(rng, kind):
    shape = (128, 128)
    image = np.full(shape, 232.0, np.float32)
    if kind == 0:  # speed limit
        alpha = _outline(shape, [], [(0.5, 0.5, 0.47, 0.47)])
        cv2.circle(image, (64, 64), 54, 95.0, 14)
        cv2.putText(image, "50", (28, 82), cv2.FONT_HERSHEY_SIMPLEX, 1.8, 25.0, 8)
    elif kind == 1:  # warning
        alpha = _outline(shape, [[(0.5, 0.04), (0.97, 0.93), (0.03, 0.93)]])
        cv2.polylines(image, [np.array([[64, 14], [114, 112], [14, 112]], np.int32)], True, 95.0, 14)
        cv2.line(image, (64, 50), (64, 84), 25.0, 9)
        cv2.circle(image, (64, 98), 5, 25.0, -1)
    elif kind == 2:  # stop
        corner = 0.29
        alpha = _outline(shape, [[(corner, 0.03), (1 - corner, 0.03), (0.97, corner), (0.97, 1 - corner),
                                  (1 - corner, 0.97), (corner, 0.97), (0.03, 1 - corner), (0.03, corner)]])
        image[:] = 88
        cv2.putText(image, "STOP", (14, 77), cv2.FONT_HERSHEY_SIMPLEX, 1.3, 240.0, 6)
    elif kind == 3:  # parking or pedestrian
        alpha = _outline(shape, [[(0.04, 0.04), (0.96, 0.04), (0.96, 0.96), (0.04, 0.96)]])
        image[:] = 92
        cv2.rectangle(image, (6, 6), (121, 121), 240.0, 5)
        cv2.putText(image, "P", (36, 98), cv2.FONT_HERSHEY_SIMPLEX, 3.0, 245.0, 14)
    elif kind == 4:  # priority road
        alpha = _outline(shape, [[(0.5, 0.02), (0.98, 0.5), (0.5, 0.98), (0.02, 0.5)]])
        image[_outline(shape, [[(0.5, 0.2), (0.8, 0.5), (0.5, 0.8), (0.2, 0.5)]]) > 127] = 172
    else:  # direction board
        alpha = _outline(shape, [[(0.02, 0.1), (0.98, 0.1), (0.98, 0.9), (0.02, 0.9)]])
        image[:] = 238
        for row in (34, 64, 94):
            for x in range(14, int(rng.integers(70, 110)), 11):
                cv2.rectangle(image, (x, row - 8), (x + 6, row + 6), 40.0, -1)
        cv2.rectangle(image, (3, 14), (124, 113), 60.0, 3)
    return image + 2.5 * noise(rng, shape, 32, 4), alpha


def _traffic_light(rng):
    image = 38 + 4 * noise(rng, (128, 64), 16, 4)
    image[:5], image[-5:], image[:, :4], image[:, -4:] = 215, 215, 215, 215
    for y, value in ((24, 235.0), (64, 82.0), (104, 70.0)):
        cv2.circle(image, (32, y), 15, 20.0, -1)
        cv2.circle(image, (32, y), 13, value, -1)
    return image


def _bars(rng, kind):
    shape = (128, 256)
    alpha = np.zeros(shape, np.float32)
    if kind == "picket":
        for x in range(4, 256, 16):
            alpha[10:, x:x + 9] = 255
        alpha[34:46], alpha[96:108] = 255, 255
        image = 168 + 8 * noise(rng, shape, 32, 4) + 6 * _speckle(rng, shape)
        image *= 1 - 0.3 * (np.arange(256)[None] % 16 > 8)
    elif kind == "wire":
        for x in range(2, 256, 16):
            alpha[4:, x:x + 5] = 255
        for y in (4, 62, 118):
            alpha[y:y + 7] = 255
        image = 58 + 8 * noise(rng, shape, 32, 4)
    else:  # guard rail
        alpha[8:78] = 255
        alpha[:, 16:32], alpha[:6, 16:32] = 255, 0
        alpha[:, 144:160], alpha[:6, 144:160] = 255, 0
        wave = np.interp(np.arange(128), (8, 20, 32, 43, 54, 66, 78), (205, 150, 120, 190, 150, 120, 200))
        image = np.repeat(wave.astype(np.float32)[:, None], 256, axis=1) + 6 * noise(rng, shape, 32, 4)
        image[80:] = 95
    return image, alpha


@lru_cache(maxsize=1)
def build(seed):
    """All textures of the world with this seed: names to indices, and the arrays for `render.render`."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 7001]))
    bank = Textures()

    def add(name, gray, alpha=None):
        def whole(image):
            return np.clip(np.rint(image), 0, 255).astype(np.uint8)
        bank.add(name, whole(gray), None if alpha is None else whole(alpha))

    road = _road(rng)
    add("lane", road[::2, ::2].copy())
    marked = _road(rng)
    _marking(rng, marked, 0.492, 0.508, 3)
    _marking(rng, marked, 0.028, 0.044, 0)
    _marking(rng, marked, 0.956, 0.972, 0)
    add("road", marked)
    highway = _asphalt(rng, (1024, 1024), 112, 2)
    for x in (0.05, 0.95):
        _marking(rng, highway, x - 0.008, x + 0.008, 0, 220)
    for x in (0.35, 0.65):
        _marking(rng, highway, x - 0.005, x + 0.005, 2, 215)
    add("highway", highway)
    add("asphalt", _asphalt(rng, (512, 512), 96, 6))
    parking = _tiles(rng, (512, 128), 64, 8, 1, spread=10) + 112 + 4 * noise(rng, (512, 128), 32, 4)
    parking[:6] = 190
    parking[256:262] = 190
    add("parking", parking)
    add("sidewalk", 148 + _tiles(rng, (512, 256), 16, 8, 2) + 6 * noise(rng, (512, 256), 64, 5)
        + 3 * _speckle(rng, (512, 256)))
    kerb = 168 + 8 * noise(rng, (512, 32), 16, 4)
    kerb[::64], kerb[1::64] = 90, 90
    add("kerb", kerb)
    grass = 76 + 10 * noise(rng, (512, 512), 128, 3) + 9 * noise(rng, (512, 512), 8, 3) + 12 * _speckle(
        rng, (512, 512), 0.9)
    add("grass", grass)
    add("gravel", 132 + 9 * noise(rng, (512, 512), 64, 4) + 13 * _speckle(rng, (512, 512), 1.2))
    add("concrete", 150 + _tiles(rng, (512, 512), 4, 4, 3, spread=4, offset=False) + 9 * noise(rng, (512, 512), 64, 5))
    add("roof", 74 + _tiles(rng, (256, 256), 20, 16, 3, spread=10) + 7 * noise(rng, (256, 256), 64, 4))
    add("stone", 126 + _tiles(rng, (256, 512), 10, 10, 4, spread=17) + 8 * noise(rng, (256, 512), 32, 5))
    add("wood", 92 + 18 * noise(rng, (8, 256), 4, 2).repeat(16, axis=0) * 0.4
        + 9 * noise(rng, (128, 256), 16, 4) - 40 * (np.arange(256)[None] % 16 < 2))
    for kind in range(FACADES):
        add(f"facade{kind}", _facade(rng, kind))
        add(f"shop{kind}", _shop(rng, kind))
    leaves = _leaves(rng, (512, 512))
    add("leaves", leaves)
    add("hedge", cv2.resize(_leaves(rng, (512, 512), 30, 100, 5), (256, 256), interpolation=cv2.INTER_AREA))
    for kind in range(TREES):
        tone = (1, 0.85, 1.1, 0.95, 0.62, 0.7)[kind]
        add(f"tree{kind}", *_tree(rng, kind, np.roll(leaves, 83 * kind, axis=1) * tone))
    bush_shape = (128, 256)
    y, x = np.mgrid[0:128, 0:256].astype(np.float32)
    for kind in range(2):
        body = 1 - ((x - 128) / 118) ** 2 - ((y - 132) / 112) ** 2 + 0.22 * noise(rng, bush_shape, 32, 5, 0.8)
        alpha = np.where((body > 0.12) & (y > 4) & (x > 3) & (x < 252), 255.0, 0.0).astype(np.float32)
        add(f"bush{kind}", leaves[:128, 256 * kind:256 * kind + 256] * (1.1 - 0.35 * y / 128), alpha)
    for kind in range(PERSONS):
        add(f"person{kind}", *_person(rng, kind))
    add("bicycle", *_bicycle(rng))
    add("rider", *_rider(rng))
    for kind, name in enumerate(("picket", "wire", "rail")):
        add(name, *_bars(rng, name))
    for kind in range(SIGNS):
        front, alpha = _sign(rng, kind)
        add(f"sign{kind}", front, alpha)
        add(f"back{kind}", 118 + 5 * noise(rng, front.shape, 32, 4), alpha[:, ::-1])
    add("light", _traffic_light(rng))
    add("metal", 92 + 7 * noise(rng, (128, 32), 16, 4) + np.linspace(35, -35, 32, dtype=np.float32)[None])
    add("bin", 62 + 9 * noise(rng, (64, 64), 16, 4) - 25 * (np.arange(64)[None] % 16 < 2))
    add("glass", _glass(rng))
    for paint_index, paint in enumerate((205, 150, 90, 52, 38, 178)):
        add(f"paint{paint_index}", paint + 5 * noise(rng, (128, 128), 64, 5) + np.linspace(
            12, -12, 128, dtype=np.float32)[:, None])
        add(f"front{paint_index}", _end(rng, paint, True))
        add(f"rear{paint_index}", _end(rng, paint, False))
        for kind in PROFILES:
            if kind in ("truck", "bus") and paint_index not in (0, 2):
                continue
            add(f"{kind}{paint_index}", *_side(rng, kind, paint))
    clouds = noise(rng, (512, 1024), 128, 6, 0.55)
    add("clouds", 128 + 60 * np.clip(clouds - 0.2, 0, 2))
    return bank.names, bank.packed()
