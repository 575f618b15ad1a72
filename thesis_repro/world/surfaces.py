"""Painted surfaces of the embedded world: asphalt, slabs and facades, and the noise that all textures share.

Each painter takes a NumPy random generator and returns gray float32 (rows, columns), albedo 0 to 255. Every surface
mixes noise of many scales with structure, so that corners are found on it from near and from far.
"""

import cv2
import numpy as np

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


def speckle(rng, shape, sigma=1.0):
    """Periodic fine grain with unit deviation, blurred by sigma pixels."""
    grain = rng.standard_normal(shape, dtype=np.float32)
    grain = cv2.GaussianBlur(np.pad(grain, 4, mode="wrap"), (0, 0), sigma)[4:-4, 4:-4]
    return grain / grain.std()


def asphalt(rng, shape, base, patches):
    """Asphalt of gray value `base` with so many repaired squares and cracks."""
    rows, columns = shape
    image = base + 5 * noise(rng, shape, 128, 3) + 5 * noise(rng, shape, 16, 3) + 5 * speckle(rng, shape, 0.8)
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


def marking(rng, image, x0, x1, dashes, value=205.0):
    """Paint a worn lane marking between two columns (parts of the width): so many dashes, or 0 for a full line."""
    rows, columns = image.shape
    line = np.zeros(image.shape, bool)
    left, right = int(round(x0 * columns)), max(int(round(x1 * columns)), int(round(x0 * columns)) + 1)
    for k in range(dashes or 1):
        top, length = (k * rows // dashes, rows // dashes // 2) if dashes else (0, rows)
        line[top:top + length, left:right] = True
    worn = noise(rng, image.shape, 16, 4) > 1.5
    image[line & ~worn] = value + 8 * speckle(rng, image.shape)[line & ~worn]


def road(rng):
    """A lane's asphalt with wheel tracks, (2048, 512)."""
    image = asphalt(rng, (2048, 512), 98, 22)
    column = np.linspace(-1, 1, 512, dtype=np.float32)
    image += 5 * np.cos(column * 3 * np.pi)[None]  # wheel tracks
    return image


def tiles(rng, shape, rows, columns, joint, offset=True, spread=9.0):
    """Slabs or bricks, to be added to a surface: a random tone for each (deviation `spread`), dark joints.

    rows, columns: of slabs in the shape; joint: pixels; offset: every other row is shifted by half a slab.
    """
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


def facade(rng, kind):
    """Two floors of four bays of a house, (512, 1024); kind: below FACADES."""
    shape = (512, 1024)
    base = (172, 128, 200, 150, 112, 186, 142, 160)[kind]
    image = base + 6 * noise(rng, shape, 256, 4) + 4 * speckle(rng, shape)
    if kind in (1, 4):
        image += tiles(rng, shape, 64, 64, 2)
    elif kind in (3, 6):
        image += tiles(rng, shape, 8, 8, 3, offset=False, spread=5)
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


def _shop_window(rng, image, x):
    """A shop window from column x on, with a sign above: dim goods on shelves behind glass that mirrors the street."""
    inside = np.full((155, 200), 66.0, np.float32) + np.linspace(-14, 16, 155, dtype=np.float32)[:, None]
    for shelf in (60, 105, 150):
        left = int(rng.integers(8, 24))
        while left < 180:
            wide, high = int(rng.integers(7, 22)), int(rng.integers(10, 34))
            tone = float(rng.uniform(74, 128))
            if rng.random() < 0.5:
                cv2.rectangle(inside, (left, shelf - high), (left + wide, shelf), tone, -1)
            else:
                cv2.ellipse(inside, (left + wide // 2, shelf - high // 2), (wide // 2, high // 2), 0, 0, 360, tone, -1)
            left += wide + int(rng.integers(3, 26))
        cv2.line(inside, (0, shelf + 2), (199, shelf + 2), 92.0, 2)
    inside = cv2.GaussianBlur(inside, (0, 0), 1.6)
    y, x_in = np.mgrid[0:155, 0:200].astype(np.float32)
    sky = np.clip((60 + rng.uniform(-20, 20) + 0.25 * (x_in - 100) - y) / 12, 0, 1)  # above the roofs opposite
    glass = inside * (1 - 0.45 * sky) + 62 * sky
    glass[np.abs((x_in + 0.6 * y) % 210 - 120) < 9] += 14
    image[60:215, x:x + 200] = glass
    for post in (x, x + 98, x + 196):
        cv2.rectangle(image, (post, 60), (post + 4, 215), 44.0, -1)
    cv2.rectangle(image, (x, 60), (x + 200, 64), 44.0, -1)
    ground = float(rng.choice([58.0, 90.0, 214.0]))
    cv2.rectangle(image, (x - 8, 14), (x + 208, 48), ground, -1)
    word = str(rng.choice(["CAFE", "OPTIK", "BLUMEN", "PAPIER", "MODE", "FRISEUR", "APOTHEKE", "BROT"]))
    (wide, _), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 0.85, 2)
    cv2.putText(image, word, (x + 100 - wide // 2, 40), cv2.FONT_HERSHEY_DUPLEX, 0.85,
                35.0 if ground > 150 else 225.0, 2, cv2.LINE_AA)
    image[48:58, x - 8:x + 208] *= 0.72  # the sign's shadow


def shop(rng, kind):
    """A ground floor, (256, 1024): doors, garages, shop windows or a plinth with small windows; kind: below FACADES."""
    shape = (256, 1024)
    base = (150, 118, 176, 132)[kind % 4]
    image = base + 6 * noise(rng, shape, 128, 4) + 4 * speckle(rng, shape)
    image += tiles(rng, shape, 8, 16, 2, spread=5)
    image[215:] *= 0.72  # plinth
    for bay in range(4):
        x = bay * 256 + 28
        what = rng.integers(0, 4)
        if what == 0:
            _shop_window(rng, image, x)
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
