"""The things of a street, as rows of the rasteriser's face matrix.

They are ground, walls, houses, cars, trees and signs. A thing is built in local coordinates:
metres, y = 0 on the ground, x and z around its foot. `place` moves it into the street. `names` maps
the names of textures to their indices.
"""

from collections.abc import Callable

import numpy as np

from street_world.drives import Track
from street_world.raster import CORNER, EDGE_S, EDGE_T, FACE_COLUMNS, X, Y, Z
from street_world.textures import CAR_HEIGHT, CAR_PROFILE, FACADES, SIGNS, TILE, TREES
from thesis_repro.data.cityscapes import ID

CAR_HALF = 0.86  # half of a car's width


class Faces:
    """A list of faces under construction.

    They are rectangles seen from outside, usually edge_s to the right and edge_t up.
    """

    def __init__(self, names: dict[str, int]) -> None:
        self.names = names
        self._rows: list[tuple] = []

    def add(
        self,
        corner: tuple[float, float, float],
        edge_s: tuple[float, float, float],
        edge_t: tuple[float, float, float],
        texture: str,
        label: str,
        repeats: tuple[float, float] = (1.0, 1.0),
        uv: tuple[float, ...] | None = None,
        gain: float = 1.0,
        triangle: int = 0,
        ground: int = 0,
        lit: int = 1,
    ) -> None:
        """Add one face.

        corner and edges: metres. The other arguments are columns that `raster` describes. repeats:
        repeats of the upright texture along edge_s and edge_t; uv: the six numbers of u and v
        instead.
        """
        uv = uv or (0.0, repeats[0], 0.0, 1.0, 0.0, -repeats[1])
        columns = (self.names[texture], ID[label], gain, triangle, ground, lit)
        self._rows.append((*corner, *edge_s, *edge_t, *uv, *columns))

    def box(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        z: tuple[float, float],
        texture: str,
        label: str,
        gain: float = 1.0,
    ) -> None:
        """Add an upright box without a bottom.

        x, y, z: (low, high) on each axis; low y is the top.
        """
        x0, x1 = x
        top, bottom = y
        z0, z1 = z
        width, height, length = x1 - x0, bottom - top, z1 - z0
        tile_u, tile_v = TILE[texture]
        for (corner_x, corner_z), (edge_x, edge_z) in (
            ((x0, z0), (width, 0)),
            ((x1, z1), (-width, 0)),
            ((x1, z0), (0, length)),
            ((x0, z1), (0, -length)),
        ):
            repeats = (abs(edge_x + edge_z) / tile_u, height / tile_v)
            corner, along, up = (corner_x, bottom, corner_z), (edge_x, 0, edge_z), (0, -height, 0)
            self.add(corner, along, up, texture, label, repeats, gain=gain)
        repeats = (width / tile_u, length / tile_v)
        lid = ((x0, top, z0), (width, 0, 0), (0, 0, length))
        self.add(*lid, texture, label, repeats, gain=gain)

    def matrix(self) -> np.ndarray:
        """Return the faces added so far, (n, FACE_COLUMNS)."""
        return np.array(self._rows, np.float64).reshape(-1, FACE_COLUMNS)


def place(faces: np.ndarray, x: float, z: float, yaw: float, y: float = 0.0) -> np.ndarray:
    """Return local faces (n, FACE_COLUMNS) turned by yaw and moved to (x, y, z).

    yaw: radians to the right.
    """
    placed = faces.copy()
    cosine, sine = np.cos(yaw), np.sin(yaw)
    for start in (CORNER, EDGE_S, EDGE_T):
        local_x, local_z = faces[:, start + X], faces[:, start + Z]
        placed[:, start + X] = cosine * local_x + sine * local_z
        placed[:, start + Z] = cosine * local_z - sine * local_x
    placed[:, CORNER + X] += x
    placed[:, CORNER + Y] += y
    placed[:, CORNER + Z] += z
    return placed


def extrude(
    names: dict[str, int],
    track: Track,
    s: np.ndarray,
    side: int,
    profile: list[tuple[float, float]],
    texture: str,
    label: str,
    off_road: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    ground: int = 0,
    lit: int = 1,
) -> np.ndarray:
    """Return the faces of a strip along a track, (n, FACE_COLUMNS).

    The strip is a road, a sidewalk, a fence or a wall. s: (k,) evenly spaced places along the
    track; side: 1 right of it, -1 mirrored to its left; profile: cross-section, (distance from the
    track, y) of points from the inner edge outwards; off_road: function of (x, z) that returns
    whether a face may lie there.
    """
    points = np.array(profile, float)
    tile_u, tile_v = TILE[texture]
    lengths = np.hypot(*np.diff(points, axis=0).T)
    v = np.concatenate([[0], np.cumsum(lengths)])
    v = -v / (tile_v or v[-1])
    if side < 0:  # points must run to the right, or the normals would look inwards
        points, v = points[::-1] * (-1, 1), v[::-1]
    u = s[:-1] / tile_u
    u_step = (s[1] - s[0]) / tile_u
    # Where a street meets itself, its later part lies a little lower. Otherwise the two would
    # flicker.
    lower = 1e-5 * (s - track.s[0])
    curvature = np.interp(track.along(s), track.s, track.curvature)
    bends = np.abs(curvature) > 1e-6
    x_middle, z_middle, heading = track.at((s[:-1] + s[1:]) / 2, points[:, 0].mean())
    free = np.ones(len(u), bool)
    if off_road is not None:
        free = off_road(x_middle, z_middle)
    parts = []
    for (d0, y0), (d1, y1), v0, v1 in zip(points, points[1:], v, v[1:]):
        x, z, _ = track.at(s, d0)
        first = np.stack([x, y0 + lower, z], axis=1)
        x, z, _ = track.at(s, d1)
        second = np.stack([x, y1 + lower, z], axis=1)
        shown = free.copy()
        for edge in (first, second):  # inside a tight bend the faces would fold over
            step = edge[1:] - edge[:-1]
            forwards = step[:, X] * np.sin(heading) + step[:, Z] * np.cos(heading)
            shown &= forwards > 0.02
        bent = (bends[:-1] | bends[1:]) & (d0 != d1)  # two triangles instead of a parallelogram
        near = (first[:-1], second[:-1] - first[:-1], first[1:] - first[:-1])
        far = (second[1:], first[1:] - second[1:], second[:-1] - second[1:])
        near_uv = (u, 0, u_step, v0, v1 - v0, 0)
        far_uv = (u + u_step, 0, -u_step, v1, v0 - v1, 0)
        columns = (names[texture], ID[label], 1.0, bent, ground, lit)
        for vectors, uv, drawn in ((near, near_uv, shown), (far, far_uv, shown & bent)):
            coordinates = np.concatenate(vectors, axis=1).T
            faces = np.broadcast_arrays(*coordinates, *uv, *columns)
            parts.append(np.stack(faces, axis=1)[drawn])
    return np.concatenate(parts)


def car(names: dict[str, int], rng: np.random.Generator) -> np.ndarray:
    """Build a car of random colour and size that looks along z, its middle at the origin."""
    faces = Faces(names)
    gain = float(rng.choice([1.55, 1.15, 0.7, 0.42, 0.32, 1.4]))
    size = rng.uniform(0.95, 1.12)
    z = size * (CAR_PROFILE[:, 0] - CAR_PROFILE[:, 0].max() / 2)
    up = CAR_PROFILE[:, 1] * rng.uniform(0.98, 1.12)
    half, length = CAR_HALF, z.max() - z.min()
    height = CAR_HEIGHT * up[0] / CAR_PROFILE[0, 1]
    for side in (1, -1):
        corner = (side * half, 0, z.min())
        faces.add(corner, (0, 0, length), (0, -height, 0), "car side", "car", gain=gain)
    materials = (
        ("car end", 0.5, 1.0),
        ("car end", 0.0, 0.5),
        ("paint", 0, 1),
        ("glass", 0, 1),
        ("paint", 0, 1),
        # front to rear: texture, top, bottom
        ("glass", 0, 1),
        ("car end", 0.0, 0.5),
        ("car end", 0.5, 1.0),
    )
    for k, (texture, top, bottom) in enumerate(materials):
        low, high, right = k + 1, k, -half  # right: as seen by somebody who looks at this part
        if up[k] < up[k + 1]:
            low, high, right = k, k + 1, half
        part_gain = gain
        if texture == "glass":
            part_gain = 1.0
        faces.add(
            (right, -up[low], z[low]),
            (-2 * right, 0, 0),
            (0, up[low] - up[high], z[high] - z[low]),
            texture,
            "car",
            uv=(0, 1, 0, bottom, 0, top - bottom),
            gain=part_gain,
        )
    return faces.matrix()


def cut_out(
    names: dict[str, int], texture: str, label: str, width: float, height: float, gain: float = 1.0
) -> np.ndarray:
    """Build two upright pictures that cross each other."""
    faces = Faces(names)
    for x, z in ((width, 0), (0, width)):
        faces.add((-x / 2, 0, -z / 2), (x, 0, z), (0, -height, 0), texture, label, lit=0, gain=gain)
    return faces.matrix()


def tree(
    names: dict[str, int], rng: np.random.Generator, lowest: float = 5.0, highest: float = 9.5
) -> np.ndarray:
    """Build a tree; lowest, highest: metres."""
    height = rng.uniform(lowest, highest)
    texture = f"tree{rng.integers(0, TREES)}"
    width = height * rng.uniform(0.85, 1.05)
    return cut_out(names, texture, "vegetation", width, height, rng.uniform(0.85, 1.2))


def bush(names: dict[str, int], rng: np.random.Generator) -> np.ndarray:
    """Build a bush: a small tree whose trunk is below the ground."""
    return place(tree(names, rng, 2.2, 4.0), 0, 0, 0, 1.2)


def lamp(names: dict[str, int], rng: np.random.Generator) -> np.ndarray:
    """Build a street lamp whose arm reaches to the left."""
    faces = Faces(names)
    height = rng.uniform(5, 7)
    faces.box((-0.07, 0.07), (-height, 0), (-0.07, 0.07), "metal", "pole")
    faces.box((-1.4, 0), (-height, -height + 0.09), (-0.05, 0.05), "metal", "pole")
    faces.box(
        (-2.1, -1.4), (-height - 0.05, -height + 0.12), (-0.14, 0.14), "metal", "pole", gain=1.3
    )
    return faces.matrix()


def sign(names: dict[str, int], rng: np.random.Generator) -> np.ndarray:
    """Build a traffic sign that is seen from z and from -z."""
    faces = Faces(names)
    kind = int(rng.integers(0, SIGNS))
    height = rng.uniform(1.9, 2.4)
    size = rng.uniform(0.65, 0.9)
    if kind == 1:  # a board
        size *= 1.4
    faces.box((-0.04, 0.04), (-height - size / 2, 0), (0.01, 0.09), "metal", "pole")
    faces.add(
        (-size / 2, -height, 0),
        (size, 0, 0),
        (0, -size, 0),
        f"sign{kind}",
        "traffic sign",
        lit=0,
        gain=1.05,
    )
    return faces.matrix()


def building(
    names: dict[str, int],
    rng: np.random.Generator,
    width: float,
    depth: float,
    floors: int,
    pitched: bool,
) -> np.ndarray:
    """Build a house whose front stands at z = 0 and looks to -z.

    pitched: a roof with a ridge instead of a flat one.
    """
    faces = Faces(names)
    facade = f"facade{rng.integers(0, FACADES)}"
    height = 3.0 * floors
    gain = rng.uniform(0.85, 1.12)
    start = rng.integers(0, 4) / 4.0
    tile_u, tile_v = TILE["facade"]
    for (corner_x, corner_z), (edge_x, edge_z) in (
        ((-width / 2, 0), (width, 0)),
        ((width / 2, depth), (-width, 0)),
        ((width / 2, 0), (0, depth)),
        ((-width / 2, depth), (0, -depth)),
    ):
        bays = max(1, round(4 * abs(edge_x + edge_z) / tile_u)) / 4  # no window is cut
        faces.add(
            (corner_x, 0, corner_z),
            (edge_x, 0, edge_z),
            (0, -height, 0),
            facade,
            "building",
            uv=(start, bays, 0, 1, 0, -height / tile_v),
            gain=gain,
        )
    if not pitched:
        roof_x = (-width / 2 - 0.15, width / 2 + 0.15)
        roof_z = (-0.15, depth + 0.15)
        faces.box(roof_x, (-height - 0.5, -height), roof_z, "stone", "building", gain * 0.8)
        return faces.matrix()
    rise, over = depth * rng.uniform(0.3, 0.5), 0.4
    lift = over * rise / (depth / 2)
    across = width + 2 * over
    tiles = (across / TILE["roof"][0], np.hypot(rise, depth / 2) / TILE["roof"][1])
    for sign_x, z in ((1, -over), (-1, depth + over)):
        faces.add(
            (-sign_x * across / 2, -height + lift, z),
            (sign_x * across, 0, 0),
            (0, -rise - lift, sign_x * (depth / 2 + over)),
            "roof",
            "building",
            tiles,
        )
    for x, z0, z1 in ((width / 2, 0, depth), (-width / 2, depth, 0)):  # gables
        faces.add(
            (x, -height, z0),
            (0, 0, z1 - z0),
            (0, -rise, (z1 - z0) / 2),
            facade,
            "building",
            uv=(0, 0.3, 0.15, 0.1, 0, -0.08),
            triangle=1,
            gain=gain,
        )
    return faces.matrix()
