"""A street of the embedded world: the ground, the things that stand and move on it, and the light.

The ground is flat, the road at y = 0 and the sidewalks a kerb higher. Cars drive on the right. A
`side` is 1 on the right and -1 on the left, looking along the track.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from street_world import raster, things
from street_world.drives import ZONES, Style, Track
from street_world.raster import Environment
from street_world.textures import PERSONS, TILE, Bank

KERB = 0.12
BEYOND = 100.0  # metres of grass around all roads, up to a forest
SKY_HEIGHT, SKY_HALF = 60.0, 5000.0  # metres; the clouds are a ceiling that fades into the haze


@dataclass
class Mover:
    """A car or person that moves along a track at a constant pace."""

    faces: np.ndarray
    track: Track
    s: float  # at frame 0
    pace: float | None  # metres a frame; None keeps the distance to the camera
    d: float
    turn: float  # radians to the right of the track's direction

    def at(self, frame: int, driven: float) -> np.ndarray:
        """Return the faces in the street at a frame.

        driven: metres that the camera has driven by then.
        """
        moved = driven
        if self.pace is not None:
            moved = self.pace * frame
        x, z, heading = self.track.at(self.s + moved, self.d)
        return things.place(self.faces, x, z, heading + self.turn)


@dataclass
class Street:
    """A street along the camera's track, and the things on it."""

    rng: np.random.Generator
    bank: Bank
    style: Style
    track: Track
    parts: list = field(default_factory=list)  # matrices of faces
    movers: list = field(default_factory=list)

    def __post_init__(self) -> None:
        self.names = self.bank.names
        self.environment = environment(self.style)
        self.crossings: list[Track] = []  # tracks of the roads that cross this one
        if self.style.crossing is not None:
            x, z, heading = self.track.at(self.style.crossing)
            self.crossings.append(Track((), -75.0, 75.0, (x, z), heading - np.pi / 2))
        roads = [self.track, *self.crossings]
        self.middle = np.concatenate([np.stack([road.x, road.z], axis=1)[::2] for road in roads])
        self.houses = np.empty((0, 2))  # points spread over all houses, at most 3 m apart
        # |d| at which houses and gardens begin
        self.line = self.style.half + (self.style.sidewalk or 3.0)

    def view(
        self,
        pose: np.ndarray,
        intrinsics: np.ndarray,
        size: tuple[int, int],
        frame: int,
        driven: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Render the image before exposure and noise (float32) and the label map (uint8).

        Both are (height, width). pose: 4x4 camera-to-world; intrinsics: 3x3, pixels; size: (height,
        width); frame, driven: as in `Mover.at`.
        """
        moved = [mover.at(frame, driven) for mover in self.movers]
        faces = np.concatenate([*self.parts, *moved])
        light = self.environment
        return raster.render(faces, self.bank.packed, pose, intrinsics, size, light)

    def off_road(self, x: float | np.ndarray, z: float | np.ndarray) -> np.ndarray:
        """Return the distance of points to the nearest edge of any road; negative on a road.

        x, z: (n,) each, metres.
        """
        return _distance(x, z, self.middle) - self.style.half

    def free(self, x: float, z: float, margin: float) -> bool:
        """Return whether a point is more than `margin` metres from all roads, and in no house."""
        off_road = self.off_road(x, z)[0] > margin
        return off_road and _distance(x, z, self.houses)[0] >= 2.4

    def put(self, faces: np.ndarray, x: float, z: float, yaw: float, y: float = -KERB) -> None:
        """Place a thing at (x, y, z), turned by yaw (radians to the right)."""
        self.parts.append(things.place(faces, x, z, yaw, y))

    def extrude(
        self,
        profile: list[tuple[float, float]],
        side: int,
        texture: str,
        label: str,
        span: tuple[float, float] | None = None,
        margin: float | None = None,
        step: float = 1.0,
        **options: int,
    ) -> None:
        """Place a strip along the main road.

        span: (start, stop); margin: metres that it keeps from all roads.
        """
        start, stop = span or (self.track.s[0], self.track.s[-1])
        places = np.linspace(start, stop, max(2, round((stop - start) / step) + 1))
        off_road = None
        if margin is not None:

            def off_road(x: np.ndarray, z: np.ndarray) -> np.ndarray:
                return self.off_road(x, z) > margin

        faces = things.extrude(
            self.names, self.track, places, side, profile, texture, label, off_road, **options
        )
        self.parts.append(faces)

    def along(self, step: float) -> Iterator[float]:
        """Yield places along the main road, about `step` metres apart."""
        s = self.track.s[0] + self.rng.uniform(0, step)
        while s < self.track.s[-1] - 3:
            yield s
            s += step * self.rng.uniform(0.75, 1.35)


def build(rng: np.random.Generator, bank: Bank, track: Track, style: Style) -> Street:
    """Lay out a street along a track; bank: result of `textures.build`."""
    street = Street(rng, bank, style, track)
    _lay_ground(street)
    _surround(street)
    for side in (-1, 1):
        _build_up(street, side)
        _furnish(street, side)
    _traffic(street)
    return street


def _distance(x: float | np.ndarray, z: float | np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distance of each place, (n,), to the nearest of the points (m, 2).

    It is infinity without points.
    """
    x = np.atleast_1d(x)[:, None]
    z = np.atleast_1d(z)[:, None]
    squared = (x - points[:, 0]) ** 2 + (z - points[:, 1]) ** 2
    return np.sqrt(squared.min(axis=1, initial=np.inf))


def _lay_ground(street: Street) -> None:
    """Place roads, kerbs and sidewalks along the tracks."""
    half, width = street.style.half, street.style.sidewalk
    street.extrude([(-half, 0), (half, 0)], 1, street.style.road, "road", step=2.0, ground=1)
    if width:
        raised = [(half, 0.05), (half, -KERB), (half + width, -KERB)]
        below = [(half - 0.02, 0.01), (half + width, 0.01)]
        for side in (-1, 1):
            street.extrude(raised, side, "sidewalk", "sidewalk", margin=0.2, ground=1)
            street.extrude(below, side, "asphalt", "road", ground=1)
    for crossing in street.crossings:
        places = np.arange(crossing.s[0], crossing.s[-1], 2.0)
        profile = [(-half, 0.005), (half, 0.005)]
        faces = things.extrude(
            street.names, crossing, places, 1, profile, "asphalt", "road", ground=1
        )
        street.parts.append(faces)


def _surround(street: Street) -> None:
    """Place grass around the roads, a forest around the grass, and the sky."""
    faces = things.Faces(street.names)
    light = street.environment
    low = street.middle.min(axis=0) - BEYOND
    high = street.middle.max(axis=0) + BEYOND
    (x, z), (width, depth) = low, high - low
    faces.add(
        (x, 0.06, z),
        (width, 0, 0),
        (0, 0, depth),
        "grass",
        "terrain",
        (width / TILE["grass"][0], depth / TILE["grass"][1]),
        ground=1,
    )
    for (corner_x, corner_z), edge in (
        (low, (width, 0)),
        (low, (0, depth)),
        (high, (-width, 0)),
        (high, (0, -depth)),
    ):
        repeats = np.abs(edge).max() / TILE["forest"][0]
        faces.add(
            (corner_x, 0.1, corner_z),
            (edge[0], 0, edge[1]),
            (0, -9, 0),
            "forest",
            "vegetation",
            (repeats, 1),
            lit=0,
        )
    repeats = 2 * SKY_HALF / TILE["sky"][0]
    faces.add(
        (-SKY_HALF, -SKY_HEIGHT, -SKY_HALF),
        (2 * SKY_HALF, 0, 0),
        (0, 0, 2 * SKY_HALF),
        "sky",
        "sky",
        (repeats, repeats),
        lit=0,
        gain=street.style.sky[0] / 128 / (light.ambient + raster.UNLIT * light.direct),
    )
    street.parts.append(faces.matrix())


def _build_up(street: Street, side: int) -> None:
    """Divide one side of the main road into stretches and fill each with a random zone."""
    rng, s, end = street.rng, street.track.s[0], street.track.s[-1]
    while s < end - 5:
        span = (s, min(s + rng.uniform(24, 60), end))
        zone = str(rng.choice(ZONES, p=street.style.zones))
        if zone == "row":
            _house_row(street, side, span, 0.02, 0.05, (2, 6), 0.5)
        elif zone == "gardens":
            _house_row(street, side, span, rng.uniform(2, 6), 4.0, (1, 4), 0.85)
            kind = str(rng.choice(["fence", "hedge", "wall"]))
            _border(street, side, span, kind, rng.uniform(0.9, 1.6))
            _scatter(street, side, span, 1.0, 12.0, 0.1)
        elif zone == "park":
            _scatter(street, side, span, 1.0, 26.0, 0.5)
            if rng.random() < 0.5:
                _border(street, side, span, "fence", 1.2)
        else:
            _border(street, side, span, "wall", rng.uniform(1.8, 2.6))
            _scatter(street, side, span, 2.0, 12.0, 0.15)
        s = span[1]


def _house_row(
    street: Street,
    side: int,
    span: tuple[float, float],
    gap: float,
    setback: float,
    floors: tuple[int, int],
    pitched: float,
) -> None:
    """Place houses side by side where there is room.

    gap: metres between houses; setback: metres behind the building line; floors: lowest number and
    one more than the highest; pitched: share of pitched roofs.
    """
    rng, s = street.rng, span[0]
    grids = np.meshgrid(np.linspace(-0.45, 0.45, 6), np.linspace(0.05, 0.95, 5))
    across, along = (grid.ravel() for grid in grids)
    while s < span[1] - 6:
        width = min(rng.uniform(9, 17), span[1] - s)
        depth = rng.uniform(8, 12)
        front = street.line + setback + rng.uniform(0, 2)
        x, z, heading = street.track.at(s + width / 2, side * front)
        yaw = heading + side * np.pi / 2
        points_x = x + width * across * np.cos(yaw) + depth * along * np.sin(yaw)
        points_z = z - width * across * np.sin(yaw) + depth * along * np.cos(yaw)
        clear = _distance(points_x, points_z, street.houses).min() >= 0.8
        if clear and street.off_road(points_x, points_z).min() > street.style.sidewalk - 0.5:
            count = int(rng.integers(*floors))
            has_ridge = rng.random() < pitched
            house = things.building(street.names, rng, width, depth, count, has_ridge)
            street.put(house, x, z, yaw)
            points = np.stack([points_x, points_z], axis=1)
            street.houses = np.concatenate([street.houses, points])
        s += width + gap


def _border(street: Street, side: int, span: tuple[float, float], kind: str, height: float) -> None:
    """Place a fence, a hedge or a wall along the building line."""
    texture, label, thickness = {
        "fence": ("picket", "fence", 0.0),
        "hedge": ("leaves", "vegetation", 0.7),
        "wall": ("stone", "wall", 0.3),
    }[kind]
    near = street.line + 0.15
    far = near + thickness
    profile = [(near, -KERB), (near, -KERB - height)]
    if thickness:
        profile += [(far, -KERB - height), (far, -KERB)]
    shorter = (span[0], span[1] - 3)
    lit = int(kind != "hedge")
    street.extrude(profile, side, texture, label, shorter, margin=1.0, step=2.0, lit=lit)


def _scatter(
    street: Street, side: int, span: tuple[float, float], near: float, far: float, density: float
) -> None:
    """Place trees and bushes `near` to `far` metres behind the building line.

    density: plants for each metre.
    """
    rng = street.rng
    for _ in range(int((span[1] - span[0]) * density) + 1):
        s = rng.uniform(*span)
        x, z, _ = street.track.at(s, side * (street.line + rng.uniform(near, far)))
        if street.free(x, z, 2.0):
            grow = things.bush
            if rng.random() < 0.65:
                grow = things.tree
            plant = grow(street.names, rng)
            street.put(plant, x, z, rng.uniform(0, np.pi))


def _furnish(street: Street, side: int) -> None:
    """Place lamps, signs, trees, persons and parked cars on one side of the main road."""
    style = street.style
    extra = 0.0
    if not style.sidewalk:
        extra = 1.2  # behind the wall of a highway
    _line_up(street, side, things.lamp, 26.0, 0.45 + extra)
    _line_up(street, side, things.sign, 21.0, 0.5 + extra)
    if not style.sidewalk:
        near = style.half + 0.7
        profile = [(near, 0), (near, -0.8), (near + 0.3, -0.8), (near + 0.3, 0.06)]
        street.extrude(profile, side, "stone", "wall", step=4.0)
        return
    _line_up(street, side, things.tree, 9.0 / style.trees, 0.8)
    _people(street, side)
    _park(street, side)


def _ahead(side: int) -> float:
    """Return the direction of the traffic on one side of the road, radians to the track's."""
    if side > 0:
        return 0.0
    return np.pi


def _line_up(
    street: Street, side: int, make: Callable[..., np.ndarray], step: float, distance: float
) -> None:
    """Place things about `step` metres apart, `distance` metres from the road's edge."""
    rng = street.rng
    for s in street.along(step):
        x, z, heading = street.track.at(s, side * (street.style.half + distance))
        if street.free(x, z, 0.3):
            faces = make(street.names, rng)
            yaw = heading + _ahead(side) + rng.uniform(-0.15, 0.15)
            street.put(faces, x, z, yaw)


def _people(street: Street, side: int) -> None:
    """Place persons who stand or walk on a sidewalk."""
    rng, style, track = street.rng, street.style, street.track
    for _ in range(int((track.s[-1] - track.s[0]) * style.persons)):
        s = rng.uniform(track.s[0], track.s[-1])
        d = side * (style.half + rng.uniform(0.6, style.sidewalk - 0.3))
        x, z, _ = track.at(s, d)
        if not street.free(x, z, 0.4):
            continue
        height = rng.uniform(1.6, 1.9)
        texture = f"person{rng.integers(0, PERSONS)}"
        faces = things.cut_out(street.names, texture, "person", height / 2, height)
        faces = things.place(faces, 0, 0, 0, -KERB)
        pace = float(rng.choice([0, 0.12, -0.12]))
        street.movers.append(Mover(faces, track, s, pace, d, rng.uniform(-0.5, 0.5)))


def _park(street: Street, side: int) -> None:
    """Place parked cars along a sidewalk, away from crossings."""
    rng, style = street.rng, street.style
    of_crossings = street.middle[len(street.track.x[::2]) :]
    for s in street.along(5.8):
        x, z, heading = street.track.at(s, side * (style.half - 1.0))
        clear = _distance(x, z, of_crossings)[0] >= style.half + 3
        if rng.random() < style.parked[side > 0] and clear:
            car = things.car(street.names, rng)
            street.put(car, x, z, heading + _ahead(side) + rng.normal(0, 0.02), 0.0)


def _traffic(street: Street) -> None:
    """Place moving cars.

    On a highway they drive beside the camera; else ahead at its pace, towards it and on a crossing.
    """
    rng, style, track = street.rng, street.style, street.track

    def drive(road: Track, s: float, pace: float | None, d: float, turn: float = 0.0) -> None:
        street.movers.append(Mover(things.car(street.names, rng), road, s, pace, d, turn))

    if not style.sidewalk:
        for k in range(int((track.s[-1] - track.s[0]) / 28)):
            lane = (-4.6, 0.0, 4.6)[k % 3]
            s = 25.0 + 26.0 * k + rng.uniform(-6, 6)
            if not lane:
                s += 35
            drive(track, s, rng.uniform(1.35, 1.75), lane)
        return
    for distance in style.leaders:
        drive(track, distance, None, 1.9)
    for s in street.along(1 / style.traffic):
        drive(track, s + 40, -rng.uniform(0.7, 1.1), -1.8, np.pi)
    for crossing in street.crossings:
        for k in range(14):
            side = -1
            if k % 2:
                side = 1
            s = -side * (12.0 + 13.0 * k + rng.uniform(-3, 3))
            drive(crossing, s, side * rng.uniform(0.6, 0.75), 1.7 * side, _ahead(side))


def environment(style: Style) -> Environment:
    """Return the light of a style as a `raster.Environment`."""
    azimuth, elevation = style.sun
    ambient, direct, shadow = 0.36, 0.86, 0.36
    if not style.sunny:
        # Under clouds the light comes from above, so shadows are faint and lie under the things.
        elevation = 1.35
        ambient, direct, shadow = 0.70, 0.30, 0.62
    sun = np.array(
        [
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
            -np.cos(elevation) * np.cos(azimuth),
        ]
    )
    return Environment(sun, ambient, direct, shadow, float(style.sky[1]), style.haze)
