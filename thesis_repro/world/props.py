"""What stands and drives in the streets of the embedded world: buildings, vehicles, signs and lamps.

Each function returns faces, (n, COLUMNS), in coordinates of the thing's own: metres, y = 0 on the ground, x and z
around its foot. `names` maps textures to their indices. `faces.place` puts them in the street.
"""

from dataclasses import dataclass

import numpy as np

from thesis_repro.world.faces import Faces
from thesis_repro.world.sprites import PROFILES, TREES, WIDTHS
from thesis_repro.world.surfaces import FACADE_TILE, FACADES, SHOP_TILE, TILE

# What the profile of a vehicle is made of from front to rear: front, paint, glass, rear.
_BODY = {"sedan": "FFPGPGPRR", "hatch": "FFPGPGRR", "estate": "FFPGPGRR", "van": "FFPGPGR", "truck": "FPGPPPPP",
         "bus": "FPGPPPR"}
_LABEL_OF = {"truck": "truck", "bus": "bus"}
_NARROW = 0.15  # metres by which a car is narrower at its ends, on each side


def vehicle(names, rng, kind):
    """A vehicle that looks along z, its middle at the origin.

    kind: of `sprites.PROFILES`; its paint is drawn from rng. The side view is cut out of two panels a side, the upper
    one leaning in; the skin between them follows the profile, two triangles for each of its parts.
    """
    paint = int(rng.choice([0, 2])) if kind in ("truck", "bus") else int(rng.integers(0, 6))
    faces = Faces(names)
    label = _LABEL_OF.get(kind, "car")
    profile = np.array(PROFILES[kind])
    length, top, half = profile[:, 0].max(), profile[:, 1].max() + 0.04, WIDTHS[kind] / 2
    belt, lean = (0.96, 0.28) if label == "car" and kind != "van" else (1.2, 0.06)

    # Seen from above the ends of a car are narrower, between them and a point of its profile each.
    knots, narrower = [0.0, length], [0.0, 0.0]
    if label == "car":
        front = max(z for z in profile[:, 0] if z < length - 0.7)
        rear = max((z for z in profile[:, 0] if z < 1.0), default=0.0)
        knots, narrower = [0.0, max(rear, 0.3), front, length], [_NARROW, 0.0, 0.0, _NARROW]

    def half_at(y, z):
        return half - lean * max(0.0, y - belt) - np.interp(z, knots, narrower)

    side, split, z0 = f"{kind}{paint}", belt / top, -length / 2
    inward = lean * (top - belt)
    for sign in (1, -1):
        for za, zb in list(zip(knots, knots[1:]))[::sign]:
            first, second = (za, zb) if sign > 0 else (zb, za)
            u = (first / length, (second - first) / length)
            xa, xb = (sign * half_at(0.0, z) for z in (first, second))
            along = (xb - xa, 0, second - first)
            faces.add((xa, 0, first + z0), along, (0, -belt, 0), side, label, uv=(*u, 0, 1, 0, -split))
            faces.add((xa, -belt, first + z0), along, (-sign * inward, belt - top, 0), side, label,
                      uv=(*u, 0, 1 - split, 0, split - 1))
    body = _BODY[kind]
    for index, material in enumerate(body):
        (za, ya), (zb, yb) = profile[index], profile[index + 1]  # from front to rear over the roof
        texture = {"F": f"front{paint}", "R": f"rear{paint}", "G": "glass", "P": f"paint{paint}"}[material]
        v_top, v_bottom = 0.0, 1.0
        if material in "FR" and body.count(material) == 2:  # one picture over two parts
            upper = (material == "F") == (index > 0 and body[index - 1] == material)
            v_top, v_bottom = (0.0, 0.5) if upper else (0.5, 1.0)
        wa, wb = half_at(ya, za), half_at(yb, zb)
        va, vb = (v_bottom, v_top) if ya < yb else (v_top, v_bottom)
        first = np.array((-wb, -yb, zb + z0))
        faces.add(first, (2 * wb, 0, 0), np.array((-wa, -ya, za + z0)) - first, texture, label, triangle=1,
                  uv=(0, 1, 0, vb, 0, va - vb))
        second = np.array((wa, -ya, za + z0))
        faces.add(second, (-2 * wa, 0, 0), np.array((wb, -yb, zb + z0)) - second, texture, label, triangle=1,
                  uv=(1, -1, 0, va, 0, vb - va))
    under = half - max(narrower)
    faces.add((-under, -0.32, z0), (2 * under, 0, 0), (0, 0, length), "bin", label, lit=0, gain=0.3)
    return faces.matrix()


def cut_out(names, texture, label, width, height, crossed=False, gain=1.0):
    """An upright picture that looks at -z, or two that cross."""
    faces = Faces(names)
    faces.add((-width / 2, 0, 0), (width, 0, 0), (0, -height, 0), texture, label, lit=0, gain=gain)
    if crossed:
        faces.add((0, 0, -width / 2), (0, 0, width), (0, -height, 0), texture, label, lit=0, gain=gain)
    return faces.matrix()


def tree(names, rng, height=None, kind=None):
    """A tree of a height (metres) and kind, which are drawn where they are not given."""
    kind = int(rng.integers(0, TREES)) if kind is None else kind
    height = rng.uniform(5, 9.5) if height is None else height
    return cut_out(names, f"tree{kind}", "vegetation", height * rng.uniform(0.85, 1.05), height, True,
                   rng.uniform(0.85, 1.2))


def bush(names, rng):
    """A bush of some width."""
    width = rng.uniform(1.4, 3.0)
    return cut_out(names, f"bush{rng.integers(0, 2)}", "vegetation", width, width * 0.55, True)


def cyclist(names):
    """A bicycle with its rider, riding along z."""
    faces = Faces(names)
    faces.add((0, 0, -0.9), (0, 0, 1.8), (0, -1.05, 0), "bicycle", "bicycle", lit=0)
    faces.add((0.02, -0.42, -0.62), (0, 0, 1.25), (0, -1.3, 0), "rider", "rider", lit=0)
    return faces.matrix()


def lamp(names, height, arm):
    """A street lamp whose arm reaches along x."""
    faces = Faces(names)
    faces.box((-0.07, 0.07), (-height, 0), (-0.07, 0.07), "metal", "pole", 2.0)
    faces.box((0, arm), (-height, -height + 0.09), (-0.05, 0.05), "metal", "pole", 2.0)
    faces.box((arm, arm + 0.7), (-height - 0.05, -height + 0.12), (-0.14, 0.14), "metal", "pole", 2.0, gain=1.3)
    return faces.matrix()


def sign(names, kind, size, height, half_pole=0.035):
    """A traffic sign that looks at -z, its lower edge at `height`; kind: below `sprites.SIGNS`."""
    faces = Faces(names)
    faces.box((-half_pole, half_pole), (-height - size / 2, 0), (0.01, 0.01 + 2 * half_pole), "metal", "pole", 2.0)
    faces.add((-size / 2, -height, 0), (size, 0, 0), (0, -size, 0), f"sign{kind}", "traffic sign", lit=0, gain=1.05)
    faces.add((size / 2, -height, 0.005), (-size, 0, 0), (0, -size, 0), f"back{kind}", "traffic sign", lit=0)
    return faces.matrix()


def traffic_light(names):
    """A traffic light that looks at -z."""
    faces = Faces(names)
    faces.box((-0.06, 0.06), (-2.4, 0), (0.02, 0.14), "metal", "pole", 2.0)
    faces.box((-0.19, 0.19), (-3.3, -2.35), (-0.1, 0.15), "bin", "traffic light", 0.5, front="light")
    return faces.matrix()


def building(names, rng, width, depth, floors, pitched):
    """A house whose front stands at z = 0 and looks at -z; the walls take whole bays of a facade.

    floors: above the ground floor; pitched: a roof with a ridge instead of a flat one.
    """
    faces = Faces(names)
    kind = int(rng.integers(0, FACADES))
    ground, height = 3.5, 3.5 + 3.0 * floors
    gain = rng.uniform(0.85, 1.12)
    start, shop = rng.integers(0, 4) / 4.0, rng.integers(0, 4) / 4.0
    for corner, edge, length in (((-width / 2, 0), (1, 0), width), ((width / 2, depth), (-1, 0), width),
                                 ((width / 2, 0), (0, 1), depth), ((-width / 2, depth), (0, -1), depth)):
        edge_s = (edge[0] * length, 0, edge[1] * length)
        bays = max(1, round(length / (FACADE_TILE[0] / 4))) / 4
        faces.add((corner[0], 0, corner[1]), edge_s, (0, -ground, 0), f"shop{kind}", "building",
                  uv=(shop, bays, 0, 1, 0, -ground / SHOP_TILE[1]), gain=gain)
        faces.add((corner[0], -ground, corner[1]), edge_s, (0, ground - height, 0), f"facade{kind}", "building",
                  uv=(start, bays, 0, 1, 0, -floors / 2), gain=gain)
    if pitched:
        rise, over = depth * rng.uniform(0.3, 0.5), 0.4
        lift = over * rise / (depth / 2)
        ridge = (0, -rise - lift, depth / 2 + over)
        across = width + 2 * over
        tiles = (across / TILE["roof"][0], np.hypot(rise, depth / 2) / TILE["roof"][1])
        faces.add((-width / 2 - over, -height + lift, -over), (across, 0, 0), ridge, "roof", "building", tiles)
        faces.add((width / 2 + over, -height + lift, depth + over), (-across, 0, 0), (0, ridge[1], -ridge[2]), "roof",
                  "building", tiles)
        for x, z0, z1 in ((width / 2, 0, depth), (-width / 2, depth, 0)):
            faces.add((x, -height, z0), (0, 0, z1 - z0), (0, -rise, (z1 - z0) / 2), f"facade{kind}", "building",
                      uv=(0, 0.3, 0.15, 0.1, 0, -0.08), triangle=1, gain=gain)
        chimney = rng.uniform(-0.3, 0.3) * width
        faces.box((chimney - 0.35, chimney + 0.35), (-height - rise - 0.9, -height - rise * 0.6),
                  (depth / 2 + 0.3, depth / 2 + 1.0), "stone", "building", 3.0, gain=0.8)
    else:
        faces.box((-width / 2 - 0.15, width / 2 + 0.15), (-height - 0.5, -height), (-0.15, depth + 0.15), "concrete",
                  "building", 8.0, gain=gain * 0.8)
    return faces.matrix()


@dataclass
class Footprint:
    """The ground plan of a building: middle of its front, yaw, half its width and its depth."""

    x: float
    z: float
    yaw: float
    half: float
    depth: float

    def near(self, x, z):
        """Whether a point may lie within it; quicker to say than `covers`."""
        return (x - self.x) ** 2 + (z - self.z) ** 2 < (self.half + self.depth + 1.0) ** 2

    def __post_init__(self):
        self.cosine, self.sine = np.cos(self.yaw), np.sin(self.yaw)
        across, along = np.meshgrid(np.linspace(-self.half, self.half, 7), np.linspace(0.0, self.depth, 5))
        across, along = across.ravel(), along.ravel()
        self.points = (self.x + self.cosine * across + self.sine * along,  # 35 spread over it: x and z
                       self.z - self.sine * across + self.cosine * along)

    def covers(self, x, z, margin=-0.3):
        """Whether it reaches within `margin` metres of any of the points; a negative margin lets walls touch."""
        dx, dz = x - self.x, z - self.z
        across = self.cosine * dx - self.sine * dz
        along = self.sine * dx + self.cosine * dz
        return bool(np.any((np.abs(across) < self.half + margin) & (along > -margin) & (along < self.depth + margin)))

    def overlaps(self, other):
        """Whether two buildings stand in each other."""
        if (self.x - other.x) ** 2 + (self.z - other.z) ** 2 > 45 ** 2:
            return False
        return self.covers(*other.points) or other.covers(*self.points)
