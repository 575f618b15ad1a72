"""Painted things of the embedded world that are cut out along their outline: trees, persons, vehicles, signs, fences.

Each painter takes a NumPy random generator and returns gray float32 (rows, columns) of albedo 0 to 255, most also an
alpha (0 to 255) of the same size.
"""

import cv2
import numpy as np

from thesis_repro.world.surfaces import noise, speckle

TREES, PERSONS, SIGNS = 6, 6, 6


def _outline(shape, polygons, ellipses=()):
    """Antialiased alpha of polygons and ellipses given in parts of the size."""
    rows, columns = shape[0] * 2, shape[1] * 2
    mask = np.zeros((rows, columns), np.uint8)
    for polygon in polygons:
        points = np.rint(np.asarray(polygon, float) * (columns, rows)).astype(np.int32)
        cv2.fillPoly(mask, [points], 255)
    for x, y, rx, ry in ellipses:
        cv2.ellipse(mask, (int(x * columns), int(y * rows)), (int(rx * columns), int(ry * rows)), 0, 0, 360, 255, -1)
    return cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def leaves(rng, shape, dark=38, light=118, leaf=4):
    """Foliage in clumps: dark to light gray, leaves of that many pixels; no alpha."""
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


def tree(rng, kind, leaves):
    """A tree in side view; kind: below TREES, the last two are conifers; leaves: (512, 512), what its crown shows."""
    shape = (512, 512)
    crown = np.zeros(shape, np.float32)
    y, x = np.mgrid[0:512, 0:512].astype(np.float32)
    if kind < 4:
        crown = 1.15 - ((x - 256) / 95) ** 2 - ((y - 205) / 120) ** 2  # around the trunk
        for _ in range(16 if kind != 3 else 11):
            angle, reach = rng.uniform(0, 2 * np.pi), 130 * np.sqrt(rng.random())
            cx, cy = 256 + reach * np.cos(angle) * 1.05, 190 + reach * np.sin(angle) * (0.95, 0.8, 1.0, 1.0)[kind]
            radius = rng.uniform(45, 85) * (1, 1, 0.9, 0.75)[kind]
            crown = np.maximum(crown, 1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius ** 2)
        threshold = (0.3, 0.36, 0.42, 0.48)[kind]
        top, bottom = 30, 350
    else:  # conifer
        crown = 1.2 - np.abs(x - 256) / (20 + (y - 10) * 0.42) - np.maximum(0, y - 440) * 0.1
        crown[y < 14] = 0
        crown += 0.15 * np.sin(y / 9)
        crown[np.abs(x - 256) > 40 + 0.42 * y] = 0
        threshold = 0.45
        top, bottom = 10, 450
    ragged = noise(rng, shape, 32, 5, 0.8)
    body = np.clip(crown, 0, 1.3) + 0.22 * ragged
    mask = (body > threshold) & (crown > 0)
    image = leaves * (1.15 - 0.5 * (y - top) / (bottom - top)) * (0.9 + 0.12 * ragged)
    trunk = np.zeros(shape, np.uint8)
    bend = int(rng.integers(-12, 13))
    half = (11, 8, 9, 7, 9, 9)[kind]
    cv2.fillPoly(trunk, [np.array([[256 - half, 512], [256 - half // 2 + bend, 150], [256 + half // 2 + bend, 150],
                                   [256 + half, 512]], np.int32)], 255)
    if kind < 4:
        branches = np.zeros(shape, np.uint8)
        for _ in range(7):
            y0 = int(rng.integers(240, 330))
            end = (256 + int(rng.integers(-110, 110)), y0 - int(rng.integers(60, 140)))
            cv2.line(branches, (256 + bend // 2, y0), end, 255, int(rng.integers(3, 7)))
        branches[(crown < 0.15) & (y < 350)] = 0  # none sticks out of the crown, which hides where they leave the trunk
        trunk |= branches
    bark = 52 + 14 * noise(rng, shape, 16, 4) + np.linspace(-14, 14, 512, dtype=np.float32)[None] * 2
    wood = (trunk > 0) & ~mask
    image[wood] = bark[wood]
    alpha = np.where(mask | (trunk > 0), 255, 0).astype(np.float32)
    alpha[:4], alpha[:, :4], alpha[:, -4:] = 0, 0, 0
    return image, cv2.GaussianBlur(alpha, (0, 0), 0.8)


def person(rng, kind):
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
    head, neck = [(0.5, 0.093, 0.08, 0.06)], [(0.46, 0.14), (0.54, 0.14), (0.56, 0.2), (0.44, 0.2)]
    shoulders = [(0.5 - shoulder + 0.05, 0.215, 0.055, 0.03), (0.5 + shoulder - 0.05, 0.215, 0.055, 0.03)]
    alpha = _outline(shape, [torso, *legs, *arms, neck], [*head, *shoulders])
    coat, trousers = float(rng.uniform(40, 190)), float(rng.uniform(42, 100))
    image = np.full(shape, trousers, np.float32)
    image[:int(0.53 * 256)] = coat
    if kind % 3 == 2:
        image[:int(0.66 * 256)] = coat
    image[(_outline(shape, arms) > 127) & (_outline(shape, [torso]) <= 127)] = coat * 0.82
    y, x = np.mgrid[0:256, 0:128].astype(np.float32)
    if kind % 3 != 2:
        image[(np.abs(x - 64) < 1.5) & (y > 0.53 * 256)] *= 0.6  # between the legs
    image[(np.abs(x - 64) < 1) & (y > 0.2 * 256) & (y < 0.52 * 256)] *= 0.7  # a zip
    image[_outline(shape, [neck]) > 127] = 96
    image[_outline(shape, [], head) > 127] = 118
    image[(_outline(shape, [], head) > 127) & (y < (0.1 if kind % 2 else 0.08) * 256)] = rng.uniform(28, 80)  # hair
    for side in (-1, 1):  # hands
        cv2.circle(image, (int((0.5 + side * (shoulder + 0.075)) * 128), int(0.505 * 256)), 5, 112.0, -1)
    image[int(0.945 * 256):] = 34
    if kind % 2:  # a bag by the side, on its strap
        cv2.line(image, (50, 50), (80, 112), coat * 0.55, 3)
        cv2.rectangle(image, (72, 112), (92, 142), coat * 0.55, -1)
    # light from one side, and folds along the limbs instead of spots
    folds = noise(rng, (16, 128), 8, 2).repeat(16, axis=0)
    return image * (1 + np.linspace(0.16, -0.2, 128, dtype=np.float32)[None]) + 2.5 * folds, alpha


def bicycle(rng):
    """A bicycle from the side, 1.8 m by 1.05 m."""
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


def rider(rng):
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
    return image + 2.5 * noise(rng, shape, 32, 3), alpha


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


def side(rng, kind, paint):
    """A vehicle from the side, looking right; kind: of PROFILES; paint: its gray value."""
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
    image = paint + 1.5 * noise(rng, shape, 128, 3)
    top = profile[:, 1].max()
    # Doors bulge: above the crease they mirror the sky, below it the street.
    up = top * (1 - np.arange(256, dtype=np.float32)[:, None] / 256)
    image *= np.interp(up, (0.2, 0.5, 0.62, 0.66, 0.9, 1.0, 1.6), (0.62, 0.8, 0.86, 1.12, 0.98, 1.2, 1.1)).astype(
        np.float32)
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
        tone = 52 + 4 * noise(rng, shape, 128, 3) + np.linspace(75, -30, 128, dtype=np.float32).repeat(2)[:, None]
        image[glass] = np.clip(tone, 30, 135)[glass]
        cv2.polylines(image, [np.rint(np.asarray(parts(pane)) * (512, 256)).astype(np.int32)], True, 26.0, 3)
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


def end(rng, paint, front):
    """Front or rear of a vehicle, from the bumper to the beltline; paint: its gray value; no alpha."""
    shape = (128, 256)
    image = paint + 1.5 * noise(rng, shape, 64, 3)
    image *= np.interp(np.arange(128), (0, 18, 22, 66, 90, 127), (1.18, 1.06, 0.94, 0.9, 1.02, 0.6)).astype(
        np.float32)[:, None]
    image *= 1 - 0.3 * np.linspace(-1, 1, 256, dtype=np.float32)[None] ** 4  # round the corners
    for middle, inwards in ((34, 1), (222, -1)):
        if front:  # a lamp behind glass
            cv2.ellipse(image, (middle, 44), (32, 15), 8 * inwards, 0, 360, 60.0, -1)
            cv2.ellipse(image, (middle, 43), (29, 12), 8 * inwards, 0, 360, 190.0, -1)
            cv2.circle(image, (middle + 8 * inwards, 44), 9, 245.0, -1)
        else:
            cv2.ellipse(image, (middle - 6 * inwards, 40), (26, 17), 0, 0, 360, 62.0, -1)
            cv2.ellipse(image, (middle + 4 * inwards, 36), (10, 6), 0, 0, 360, 150.0, -1)
    if front:
        grille = np.zeros(shape, np.uint8)
        cv2.fillPoly(grille, [np.array([[76, 36], [180, 36], [170, 62], [86, 62]], np.int32)], 255)
        image[grille > 0] = (34 + 40 * (np.arange(128)[:, None] % 7 < 2) + np.zeros(shape))[grille > 0]
        cv2.rectangle(image, (60, 100), (196, 116), 34.0, -1)  # air intake
    else:
        cv2.line(image, (20, 66), (236, 66), paint * 0.6, 2)
        cv2.line(image, (0, 96), (255, 96), paint * 0.7, 2)
    cv2.rectangle(image, (92, 70), (164, 90), 225.0, -1)
    for k in range(6):
        cv2.rectangle(image, (98 + 10 * k, 74), (103 + 10 * k, 86), 40.0, -1)
    return image


def glass(rng):
    """A windscreen or rear window, between whose frames the seats are seen; no alpha."""
    y, x = np.mgrid[0:128, 0:128].astype(np.float32)
    image = 64 + 3 * noise(rng, (128, 128), 64, 3) + 60 * np.clip(1.1 - y / 70 - 0.3 * np.sin(x / 40), 0, 1)  # sky
    for left in (36, 92):  # seats seen through it
        cv2.ellipse(image, (left, 78), (10, 9), 0, 0, 360, 40.0, -1)
        cv2.ellipse(image, (left, 122), (19, 34), 0, 180, 360, 40.0, -1)
    image[:5], image[-5:], image[:, :5], image[:, -5:] = 28, 28, 28, 28
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def sign(rng, kind):
    """The front of a traffic sign; kind: below SIGNS."""
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


def traffic_light(rng):
    """The front of a traffic light that shows its upper lamp; no alpha."""
    image = 38 + 4 * noise(rng, (128, 64), 16, 4)
    image[:5], image[-5:], image[:, :4], image[:, -4:] = 215, 215, 215, 215
    for y, value in ((24, 235.0), (64, 82.0), (104, 70.0)):
        cv2.circle(image, (32, y), 15, 20.0, -1)
        cv2.circle(image, (32, y), 13, value, -1)
    return image


def bars(rng, kind):
    """A stretch of "picket" or "wire" fence, or of a guard "rail"."""
    shape = (128, 256)
    alpha = np.zeros(shape, np.float32)
    if kind == "picket":
        for x in range(4, 256, 16):
            alpha[10:, x:x + 9] = 255
        alpha[34:46], alpha[96:108] = 255, 255
        image = 168 + 8 * noise(rng, shape, 32, 4) + 6 * speckle(rng, shape)
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
