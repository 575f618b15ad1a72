"""A street of the embedded world: how it looks, what it consists of, and the plan that it is laid out on.

The ground is flat, the road at y = 0 and the sidewalks a kerb higher; cars drive on the right. A side of a road is
1 on the right and -1 on the left, looking along its track.
"""

from dataclasses import dataclass, field

import numpy as np

from thesis_repro.world.faces import place
from thesis_repro.world.raster import GROUND_LEVELS, SIDEWALK, Environment, Textures
from thesis_repro.world.render import render
from thesis_repro.world.track import Track

KERB = -GROUND_LEVELS[SIDEWALK]
LAYER = 0.001  # metres that keep apart what lies on top of each other


@dataclass(frozen=True)
class Style:
    """What a street looks like; widths in metres."""

    half: float = 3.8  # half of the road
    road: str = "road"  # its texture; a "highway" has guard rails and no sidewalks
    parking: tuple = (0.0, 2.2)  # left, right
    sidewalk: float = 2.6
    zones: tuple = ("blocks", "houses", "park", "wall")  # of zones.ZONES
    weights: tuple = (0.5, 0.25, 0.15, 0.1)
    parked: float = 0.6  # part of the parking slots that are taken
    trees: float = 0.5  # street trees
    persons: float = 0.05  # for each metre of sidewalk
    traffic: float = 0.01  # oncoming cars for each metre
    sunny: bool = True
    sun: tuple = (0.5, 0.8)  # azimuth the light comes from, elevation (radians)
    sky: tuple = (150.0, 205.0, 0.4)  # zenith, horizon, clouds
    haze: float = 0.003
    leaders: tuple = ()  # distances of cars that drive ahead at the camera's pace
    crossing: float | None = None  # s of a crossing with cars that pass ahead of a waiting camera
    bridge: float | None = None  # s of a bridge over the road


@dataclass
class Mover:
    """A car, rider or person that moves along a track at a steady pace (metres a frame).

    pace: None keeps its distance to the camera; turn: what it looks to the right of the track (radians).
    """

    faces: np.ndarray
    track: Track
    s: float  # at frame 0
    pace: float | None
    d: float
    turn: float

    def at(self, frame, driven):
        """Its faces in the street at a frame; driven: metres that the camera has come by then."""
        x, z, heading = self.track.at(self.s + (driven if self.pace is None else self.pace * frame), self.d)
        return place(self.faces, x, z, heading + self.turn)


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
        return render(np.concatenate([self.faces, *moved]), self.textures, pose, intrinsics, size, self.environment)


@dataclass(frozen=True)
class Road:
    """A road of a plan; lower: metres that it lies below the roads before it, so that none flickers through another."""

    track: Track
    half: float
    parking: tuple = (0.0, 0.0)
    lower: float = 0.0

    def lane(self, side):
        """Width of the parking lane on one side, 0 for none."""
        return self.parking[side > 0]


@dataclass
class Plan:
    """A street in the making: its roads, first the one that the camera drives, and what has been put up so far."""

    rng: np.random.Generator
    names: dict  # of the textures
    style: Style
    roads: list
    parts: list = field(default_factory=list)  # matrices of faces
    movers: list = field(default_factory=list)
    buildings: list = field(default_factory=list)  # footprints

    def __post_init__(self):
        middles = [np.stack([road.track.x, road.track.z], axis=1)[::2] for road in self.roads]
        self.middle = np.concatenate(middles)  # (n, 2) points of all roads: x, z
        self._middle_x, self._middle_z = np.ascontiguousarray(self.middle.T)
        self._starts = np.cumsum([0, *map(len, middles[:-1])])  # of each road among them
        self._halves = np.array([road.half for road in self.roads])
        self._halves_parked = np.array([road.half + max(road.parking) for road in self.roads])

    @property
    def main(self):
        return self.roads[0]

    def off_road(self, x, z, parked=False):
        """Distance of points, (n,) each, to the nearest edge of any road; negative on a road.

        parked: parking lanes are part of the road.
        """
        halves = self._halves_parked if parked else self._halves
        x, z = np.atleast_1d(x), np.atleast_1d(z)
        result = np.empty(len(x))
        for start in range(0, len(x), 256):  # a bounded table of distances
            part = slice(start, start + 256)
            squared = x[part, None] - self._middle_x
            squared *= squared
            dz = z[part, None] - self._middle_z
            dz *= dz
            squared += dz
            nearest = np.minimum.reduceat(squared, self._starts, axis=1)  # of each road
            result[part] = (np.sqrt(nearest) - halves).min(axis=1)
        return result

    def free(self, x, z, margin):
        """Whether a point lies more than `margin` metres off all roads, and half a metre off all buildings."""
        return self.off_road(x, z)[0] > margin and not any(b.near(x, z) and b.covers(x, z, 0.5) for b in self.buildings)

    def building_line(self, road, side):
        """Distance from a road's middle to where its buildings begin."""
        if self.style.road == "highway":
            return road.half + 3.0
        return road.half + road.lane(side) + self.style.sidewalk

    def put(self, faces, x, z, yaw, y=-KERB):
        """Put up a thing at (x, y, z), turned by yaw (radians to the right)."""
        self.parts.append(place(faces, x, z, yaw, y))
