"""A street of the embedded world: how it looks, what stands and moves on it, and the light.

The ground is flat, the road at y = 0 and the sidewalks a kerb higher; cars drive on the right. A side of a road is
1 on the right and -1 on the left, looking along its track.
"""

from dataclasses import dataclass, field

import numpy as np

from thesis_repro.world import raster, things
from thesis_repro.world.raster import Environment, Textures
from thesis_repro.world.textures import PERSONS, TILE

KERB = 0.12
BEYOND = 100.0  # metres of grass around all roads, up to a forest
SKY_HEIGHT, SKY_HALF = 60.0, 5000.0  # metres; the clouds are a ceiling that fades into the haze
ZONES = ("row", "gardens", "park", "wall")


@dataclass(frozen=True)
class Style:
    """What a street looks like; widths in metres."""

    half: float = 5.5  # half of the road
    road: str = "road"  # its texture
    sidewalk: float = 2.6  # 0: a highway, with low walls
    parked: tuple = (0.0, 0.0)  # part of the parking places that are taken, left and right
    zones: tuple = (0.55, 0.2, 0.15, 0.1)  # shares of ZONES
    trees: float = 0.5  # street trees
    persons: float = 0.05  # for each metre of sidewalk
    traffic: float = 0.01  # oncoming cars for each metre
    sunny: bool = True
    sun: tuple = (0.5, 0.8)  # azimuth the light comes from, elevation (radians)
    sky: tuple = (150.0, 205.0)  # gray of the sky between the clouds, and of the haze at the horizon
    haze: float = 0.003
    leaders: tuple = ()  # distances of cars that drive ahead at the camera's pace
    crossing: float | None = None  # s of a crossing with cars that pass ahead of a waiting camera


@dataclass
class Mover:
    """A car or person that moves along a track at a steady pace (metres a frame).

    pace: None keeps its distance to the camera; turn: what it looks to the right of the track (radians).
    """

    faces: np.ndarray
    track: object  # a `drives.Track`
    s: float  # at frame 0
    pace: float | None
    d: float
    turn: float

    def at(self, frame, driven):
        """Its faces in the street at a frame; driven: metres that the camera has come by then."""
        x, z, heading = self.track.at(self.s + (driven if self.pace is None else self.pace * frame), self.d)
        return things.place(self.faces, x, z, heading + self.turn)


@dataclass
class Street:
    """A street that is ready to be rendered."""

    faces: np.ndarray
    movers: list
    textures: Textures
    environment: Environment

    def view(self, pose, intrinsics, size, frame, driven=0.0):
        """Image (float32, before exposure and noise) and label map (uint8), both of `size`, (height, width).

        pose: 4x4 camera-to-world; intrinsics: 3x3, pixels; frame, driven: when, as `Mover.at` takes them.
        """
        moved = [mover.at(frame, driven) for mover in self.movers]
        return raster.render(np.concatenate([self.faces, *moved]), self.textures, pose, intrinsics, size,
                             self.environment)


def build(rng, bank, track, style, crossing=None):
    """Lay out a `Street` along a `drives.Track`.

    rng: NumPy generator, on which alone the street depends besides these; bank: of `textures.build`; style: `Style`;
    crossing: the track of a road that crosses it.
    """
    plan = _Plan(rng, bank.names, style, track, [road for road in (track, crossing) if road is not None])
    _lay_ground(plan)
    _surround(plan)
    for side in (-1, 1):
        _build_up(plan, side)
        _furnish(plan, side)
    _traffic(plan, crossing)
    return Street(np.ascontiguousarray(np.concatenate(plan.parts)), plan.movers, bank.packed, environment(style))


@dataclass
class _Plan:
    """A street in the making: its roads, first the one that the camera drives, and what has been put up so far."""

    rng: np.random.Generator
    names: dict  # of the textures
    style: Style
    track: object
    roads: list
    parts: list = field(default_factory=list)  # matrices of faces
    movers: list = field(default_factory=list)

    def __post_init__(self):
        self.middle = np.concatenate([np.stack([road.x, road.z], axis=1)[::2] for road in self.roads])
        self.houses = np.empty((0, 2))  # points spread over all houses, at most 3 m apart
        self.line = self.style.half + (self.style.sidewalk or 3.0)  # from the middle to where houses and gardens begin

    def off_road(self, x, z):
        """Distance of points, (n,) each, to the nearest edge of any road; negative on a road."""
        x, z = np.atleast_1d(x), np.atleast_1d(z)
        return _nearest(x, z, self.middle) - self.style.half

    def free(self, x, z, margin):
        """Whether a point lies more than `margin` metres off all roads, and off all houses."""
        return self.off_road(x, z)[0] > margin and not _near(x, z, self.houses, 2.4)

    def put(self, faces, x, z, yaw, y=-KERB):
        """Put up a thing at (x, y, z), turned by yaw (radians to the right)."""
        self.parts.append(things.place(faces, x, z, yaw, y))

    def extrude(self, profile, side, texture, label, span=None, margin=None, step=1.0, **options):
        """Put up what runs along the main road between two places; margin: metres that it keeps off all roads."""
        start, stop = span or (self.track.s[0], self.track.s[-1])
        places = np.linspace(start, stop, max(2, round((stop - start) / step) + 1))
        off_road = None if margin is None else lambda x, z: self.off_road(x, z) > margin
        self.parts.append(things.extrude(self.names, self.track, places, side, profile, texture, label, off_road,
                                         **options))

    def along(self, step):
        """Places along the main road, about `step` metres apart."""
        s = self.track.s[0] + self.rng.uniform(0, step)
        while s < self.track.s[-1] - 3:
            yield s
            s += step * self.rng.uniform(0.75, 1.35)


def _nearest(x, z, points):
    """Distance of each place, (n,), to the nearest of some points, (m, 2)."""
    return np.sqrt(((x[:, None] - points[:, 0]) ** 2 + (z[:, None] - points[:, 1]) ** 2).min(axis=1))


def _near(x, z, points, distance):
    """Whether any of some points, (m, 2), lies within a distance of any of the places."""
    return len(points) > 0 and bool(_nearest(np.atleast_1d(x), np.atleast_1d(z), points).min() < distance)


def _lay_ground(plan):
    """Roads, kerbs and sidewalks along the tracks."""
    half, width = plan.style.half, plan.style.sidewalk
    plan.extrude([(-half, 0), (half, 0)], 1, plan.style.road, "road", step=2.0, ground=1)
    if width:
        for side in (-1, 1):
            plan.extrude([(half, 0.05), (half, -KERB), (half + width, -KERB)], side, "sidewalk", "sidewalk",
                         margin=0.2, ground=1)
            plan.extrude([(half - 0.02, 0.01), (half + width, 0.01)], side, "asphalt", "road", ground=1)
    for crossing in plan.roads[1:]:
        places = np.arange(crossing.s[0], crossing.s[-1], 2.0)
        plan.parts.append(things.extrude(plan.names, crossing, places, 1, [(-half, 0.005), (half, 0.005)], "asphalt",
                                         "road", ground=1))


def _surround(plan):
    """Grass around the roads, a forest around the grass, and the sky."""
    faces, light = things.Faces(plan.names), environment(plan.style)
    low, high = plan.middle.min(axis=0) - BEYOND, plan.middle.max(axis=0) + BEYOND
    (x, z), (width, depth) = low, high - low
    faces.add((x, 0.06, z), (width, 0, 0), (0, 0, depth), "grass", "terrain",
              (width / TILE["grass"][0], depth / TILE["grass"][1]), ground=1)
    for corner, edge in (((x, z), (width, 0)), ((x, z), (0, depth)), (high, (-width, 0)), (high, (0, -depth))):
        faces.add((corner[0], 0.1, corner[1]), (edge[0], 0, edge[1]), (0, -9, 0), "forest", "vegetation",
                  (np.abs(edge).max() / TILE["forest"][0], 1), lit=0)
    faces.add((-SKY_HALF, -SKY_HEIGHT, -SKY_HALF), (2 * SKY_HALF, 0, 0), (0, 0, 2 * SKY_HALF), "sky", "sky",
              (2 * SKY_HALF / TILE["sky"][0],) * 2, lit=0,
              gain=plan.style.sky[0] / 128 / (light.ambient + raster.UNLIT * light.direct))
    plan.parts.append(faces.matrix())


def _build_up(plan, side):
    """Divide one side of the main road into stretches and fill each with a zone of the style."""
    rng, s, end = plan.rng, plan.track.s[0], plan.track.s[-1]
    while s < end - 5:
        span = (s, min(s + rng.uniform(24, 60), end))
        zone = str(rng.choice(ZONES, p=plan.style.zones))
        if zone == "row":
            _house_row(plan, side, span, 0.02, 0.05, (2, 6), 0.5)
        elif zone == "gardens":
            _house_row(plan, side, span, rng.uniform(2, 6), 4.0, (1, 4), 0.85)
            _border(plan, side, span, str(rng.choice(["fence", "hedge", "wall"])), rng.uniform(0.9, 1.6))
            _scatter(plan, side, span, 1.0, 12.0, 0.1)
        elif zone == "park":
            _scatter(plan, side, span, 1.0, 26.0, 0.5)
            if rng.random() < 0.5:
                _border(plan, side, span, "fence", 1.2)
        else:
            _border(plan, side, span, "wall", rng.uniform(1.8, 2.6))
            _scatter(plan, side, span, 2.0, 12.0, 0.15)
        s = span[1]


def _house_row(plan, side, span, gap, setback, floors, pitched):
    """Houses side by side where there is room; gap, setback: metres; floors: least, one more than most; pitched: part
    of the roofs."""
    rng, s = plan.rng, span[0]
    across, along = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.45, 0.45, 6), np.linspace(0.05, 0.95, 5)))
    while s < span[1] - 6:
        width, depth = min(rng.uniform(9, 17), span[1] - s), rng.uniform(8, 12)
        x, z, heading = plan.track.at(s + width / 2, side * (plan.line + setback + rng.uniform(0, 2)))
        yaw = heading + side * np.pi / 2
        points = np.stack([x + width * across * np.cos(yaw) + depth * along * np.sin(yaw),
                           z - width * across * np.sin(yaw) + depth * along * np.cos(yaw)], axis=1)
        if plan.off_road(*points.T).min() > plan.style.sidewalk - 0.5 and not _near(*points.T, plan.houses, 0.8):
            plan.put(things.building(plan.names, rng, width, depth, int(rng.integers(*floors)), rng.random() < pitched),
                     x, z, yaw)
            plan.houses = np.concatenate([plan.houses, points])
        s += width + gap


def _border(plan, side, span, kind, height):
    """A fence, a hedge or a wall along the building line."""
    texture, label, thickness = {"fence": ("picket", "fence", 0.0), "hedge": ("leaves", "vegetation", 0.7),
                                 "wall": ("stone", "wall", 0.3)}[kind]
    near, far = plan.line + 0.15, plan.line + 0.15 + thickness
    profile = [(near, -KERB), (near, -KERB - height)]
    if thickness:
        profile += [(far, -KERB - height), (far, -KERB)]
    plan.extrude(profile, side, texture, label, (span[0], span[1] - 3), margin=1.0, step=2.0, lit=int(kind != "hedge"))


def _scatter(plan, side, span, near, far, density):
    """Trees and bushes, so many for each metre, from `near` to `far` metres behind the building line."""
    for _ in range(int((span[1] - span[0]) * density) + 1):
        x, z, _ = plan.track.at(plan.rng.uniform(*span), side * (plan.line + plan.rng.uniform(near, far)))
        if plan.free(x, z, 2.0):
            plant = things.tree if plan.rng.random() < 0.65 else things.bush
            plan.put(plant(plan.names, plan.rng), x, z, plan.rng.uniform(0, np.pi))


def _furnish(plan, side):
    """What stands and walks on one side of the main road, and what parks there."""
    rng, style, track = plan.rng, plan.style, plan.track
    ahead = 0.0 if side > 0 else np.pi  # looks the way one drives on that side
    for make, step, distance in ((things.lamp, 26.0, 0.45), (things.sign, 21.0, 0.5),
                                 (things.tree, 9.0 / style.trees, 0.8)):
        if make is things.tree and not style.sidewalk:
            continue
        for s in plan.along(step):
            x, z, heading = track.at(s, side * (style.half + distance + (0 if style.sidewalk else 1.2)))
            if plan.free(x, z, 0.3):
                plan.put(make(plan.names, rng), x, z, heading + ahead + rng.uniform(-0.15, 0.15))
    if not style.sidewalk:
        near = style.half + 0.7
        plan.extrude([(near, 0), (near, -0.8), (near + 0.3, -0.8), (near + 0.3, 0.06)], side, "stone", "wall", step=4.0)
        return
    for _ in range(int((track.s[-1] - track.s[0]) * style.persons)):
        s, d = rng.uniform(track.s[0], track.s[-1]), side * (style.half + rng.uniform(0.6, style.sidewalk - 0.3))
        if plan.free(*track.at(s, d)[:2], 0.4):
            height = rng.uniform(1.6, 1.9)
            faces = things.cut_out(plan.names, f"person{rng.integers(0, PERSONS)}", "person", height / 2, height)
            plan.movers.append(Mover(things.place(faces, 0, 0, 0, -KERB), track, s, float(rng.choice([0, 0.12, -0.12])),
                                     d, rng.uniform(-0.5, 0.5)))
    for s in plan.along(5.8):
        x, z, heading = track.at(s, side * (style.half - 1.0))
        if rng.random() < style.parked[side > 0] and not _near(x, z, plan.middle[len(track.x[::2]):], style.half + 3):
            plan.put(things.car(plan.names, rng), x, z, heading + ahead + rng.normal(0, 0.02), 0.0)


def _traffic(plan, crossing):
    """Cars that drive: ahead at the camera's pace, towards it, across the road, or beside it on a highway."""
    rng, style, track = plan.rng, plan.style, plan.track

    def drive(road, s, pace, d, turn=0.0):
        plan.movers.append(Mover(things.car(plan.names, rng), road, s, pace, d, turn))

    if not style.sidewalk:
        for k in range(int((track.s[-1] - track.s[0]) / 28)):
            lane = (-4.6, 0.0, 4.6)[k % 3]
            drive(track, 25.0 + 26.0 * k + rng.uniform(-6, 6) + (0 if lane else 35), rng.uniform(1.35, 1.75), lane)
        return
    for distance in style.leaders:
        drive(track, distance, None, 1.9)
    for s in plan.along(1 / style.traffic):
        drive(track, s + 40, -rng.uniform(0.7, 1.1), -1.8, np.pi)
    for k in range(14 if crossing else 0):
        side = 1 if k % 2 else -1
        drive(crossing, -side * (12.0 + 13.0 * k + rng.uniform(-3, 3)), side * rng.uniform(0.6, 0.75), 1.7 * side,
              0.0 if side > 0 else np.pi)


def environment(style):
    """The light of a style, a `raster.Environment`."""
    azimuth, elevation = style.sun if style.sunny else (style.sun[0], 1.35)
    sun = np.array([-np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])
    # Under clouds the light comes from above and shadows are faint pools under things.
    ambient, direct, shadow = (0.36, 0.86, 0.36) if style.sunny else (0.70, 0.30, 0.62)
    return Environment(sun, ambient, direct, shadow, float(style.sky[1]), style.haze)
