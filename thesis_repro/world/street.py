"""Streets of the embedded world: a curved road and everything beside it, as faces for the rasteriser.

A place on a street is (s, d): metres along the road's middle and metres to the right of it. The ground is flat, the
road at y = 0 and the sidewalks a kerb higher; cars drive on the right.
"""

from dataclasses import dataclass

import numpy as np

from thesis_repro.cityscapes import ID
from thesis_repro.world import render
from thesis_repro.world.props import (
    Faces,
    Footprint,
    building,
    cut_out,
    cyclist,
    lamp,
    place,
    sign,
    traffic_light,
    vehicle,
)
from thesis_repro.world.sprites import PERSONS, SIGNS, TREES
from thesis_repro.world.surfaces import TILE, noise

KERB = -render.GROUND_LEVELS[2]
STEP = 0.25  # metres between the stored points of a track
BEHIND, AHEAD = 30.0, 170.0  # metres of street behind the first and ahead of the last camera
ROAD, SIDEWALK = 1, 2  # ground levels
LAYER = 0.001  # metres that keep apart what lies on top of each other


class Track:
    """The middle line of a road: pieces (metres, degrees to the right) from `start`, repeated up to `stop`."""

    def __init__(self, pieces, start, stop, origin=(0.0, 0.0), heading=0.0, smoothing=3.0, repeat=True):
        count = int(np.ceil((stop - start) / STEP)) + 1
        self.s = start + STEP * np.arange(count)
        self.curvature = np.zeros(count)
        self.corners = []
        where = 0.0
        while pieces and where < stop:
            for length, degrees in pieces:
                inside = (self.s >= where) & (self.s < where + length)
                self.curvature[inside] = np.radians(degrees) / length
                if abs(degrees) >= 60 and length < 25:
                    self.corners.append(where)
                where += length
            if not repeat:
                break
        window = max(1, int(smoothing / STEP))  # a driver turns the wheel, the curvature does not jump
        padded = np.pad(self.curvature, (window // 2, window - 1 - window // 2), mode="edge")
        total = np.concatenate([[0.0], np.cumsum(padded)])
        self.curvature = (total[window:] - total[:-window]) / window
        first = int(round(-start / STEP))
        turn = np.concatenate([[0.0], np.cumsum(0.5 * (self.curvature[1:] + self.curvature[:-1])) * STEP])
        self.heading = heading + turn - turn[first]
        middle = 0.5 * (self.heading[1:] + self.heading[:-1])
        x = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * STEP])
        z = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * STEP])
        self.x, self.z = origin[0] + x - x[first], origin[1] + z - z[first]

    def at(self, s, d=0.0):
        """(x, z, heading) of places (s, d)."""
        heading = np.interp(s, self.s, self.heading)
        x = np.interp(s, self.s, self.x) + d * np.cos(heading)
        z = np.interp(s, self.s, self.z) - d * np.sin(heading)
        return x, z, heading


@dataclass(frozen=True)
class Style:
    """What a street looks like; widths in metres."""

    half: float = 3.8  # half of the road
    road: str = "road"
    parking: tuple = (0.0, 2.2)  # left, right
    sidewalk: float = 2.6
    zones: tuple = ("blocks", "houses", "park", "wall")
    weights: tuple = (0.5, 0.25, 0.15, 0.1)
    parked: float = 0.6  # part of the parking slots that are taken
    trees: float = 0.5  # street trees
    persons: float = 0.05  # for each metre of sidewalk
    traffic: float = 0.01  # oncoming cars for each metre
    sunny: bool = True
    sun: tuple = (0.5, 0.8)  # azimuth the light comes from, elevation (radians)
    sky: tuple = (150.0, 205.0, 0.4)  # zenith, horizon, clouds
    haze: float = 0.003
    leader: float = 0.0  # distance of a car driving ahead at the camera's pace
    crossing: float = -1.0  # s of a crossing with cars that pass ahead of a waiting camera
    bridge: float = -1.0  # s of a bridge over the road


@dataclass
class Mover:
    """A car, rider or person that moves along a track at a steady pace (metres a frame)."""

    faces: np.ndarray
    track: Track
    s: float
    pace: float
    d: float
    turn: float = 0.0

    def at(self, frame, followed):
        # A leading car keeps its distance to the camera instead of an own pace.
        s = self.s + (followed if self.pace == FOLLOWS else self.pace * frame)
        x, z, heading = self.track.at(s, self.d)
        return place(self.faces, x, z, heading + self.turn)


FOLLOWS = -99.0

@dataclass
class Street:
    """A street that is ready to be rendered."""

    textures: tuple
    track: Track
    style: Style
    faces: np.ndarray
    movers: list
    environment: np.ndarray
    horizon: np.ndarray
    horizon_labels: np.ndarray
    ground_label: int = ID["terrain"]

    def view(self, pose, intrinsics, size, frame=0, followed=0.0):
        """Image (float32, before exposure and noise) and label map (uint8) from a 4x4 camera-to-world pose."""
        moved = [mover.at(frame, followed) for mover in self.movers]
        return render.render(np.concatenate([self.faces, *moved]), self.textures, pose, intrinsics, size,
                             self.environment, self.horizon, self.horizon_labels, self.ground_label)


class _Builder:
    """Lays out one street. `roads` are the main road and the ones that leave it, each with half its width."""

    def __init__(self, rng, bank, track, style):
        self.rng, self.names, self.track, self.style = rng, bank[0], track, style
        self.parts, self.movers, self.buildings = [], [], []
        self.roads = [(track, style.half)]
        for corner in track.corners:  # at a sharp turn the old direction goes on as a side road
            if corner < track.s[-1] - 40:
                x, z, heading = track.at(corner - 4.0)
                self.roads.append((Track([], 0.0, 70.0, (x, z), heading), style.half * 0.9))
        s = track.s[0] + 60
        while s < track.s[-1] - 20 and style.road != "highway":
            s += rng.uniform(35, 80)
            if np.interp(s, track.s, np.abs(track.curvature)) < 0.01:
                x, z, heading = track.at(s)
                quarter = np.pi / 2 * rng.choice([-1, 1])
                self.roads.append((Track([], 0.0, 70.0, (x, z), heading + quarter), style.half * 0.85))
        if style.crossing >= 0:
            x, z, heading = track.at(style.crossing)
            crossing = Track([], -75.0, 75.0, (x, z), heading - np.pi / 2)
            self.roads.append((crossing, style.half))
            for k in range(14):
                lane = 1 if k % 2 else -1
                self._mover(crossing, -lane * (12.0 + 13.0 * k + rng.uniform(-3, 3)), lane * rng.uniform(0.6, 0.75),
                            1.7 * lane, 0.0 if lane > 0 else np.pi)
        middles = [np.stack([road.x, road.z], axis=1)[::2] for road, _ in self.roads]
        self.middle = np.concatenate(middles)
        self.halves = np.concatenate([np.full(len(m), half) for m, (_, half) in zip(middles, self.roads)])
        self.halves_parked = self.halves.copy()
        self.halves_parked[:len(middles[0])] += max(style.parking)

    def off_road(self, x, z, parked=False):
        """Distance of points to the nearest edge of any road; negative on a road. `parked` adds its parking lanes."""
        halves = self.halves_parked if parked else self.halves
        x, z = np.atleast_1d(x), np.atleast_1d(z)
        result = np.empty(len(x))
        for start in range(0, len(x), 256):
            part = slice(start, start + 256)
            dx = x[part, None] - self.middle[None, :, 0]
            dz = z[part, None] - self.middle[None, :, 1]
            result[part] = (np.sqrt(dx * dx + dz * dz) - halves).min(axis=1)
        return result

    def free(self, x, z, margin):
        return self.off_road(x, z)[0] > margin and not any(b.near(x, z) and b.covers(x, z, 0.5) for b in self.buildings)

    def put(self, faces, x, z, yaw, y=-KERB, gain=1.0):
        placed = place(faces, x, z, yaw, y)
        placed[:, render.GAIN] *= gain
        self.parts.append(placed)

    def strip(self, road, s_from, s_to, d0, d1, y, texture, label, ground, keep_off=None, whole_width=False):
        """A band of ground between d0 < d1; cells on another road are left out."""
        step = 1.0 if ground == SIDEWALK or keep_off is not None else 2.0
        s = np.arange(s_from, s_to + step / 2, step)
        if len(s) < 2:
            return
        tile_u, tile_v = TILE[texture]
        x0, z0, _ = road.at(s, d0)
        x1, z1, _ = road.at(s, d1)
        straight = np.abs(np.interp(s, road.s, road.curvature)) < 1e-6
        rows = len(s) - 1
        near, far = slice(0, rows), slice(1, rows + 1)
        # Inside a tight bend the band would fold over.
        ahead0 = (x0[far] - x0[near]) * np.sin(road.at(s[near])[2]) + (z0[far] - z0[near]) * np.cos(road.at(s[near])[2])
        ahead1 = (x1[far] - x1[near]) * np.sin(road.at(s[near])[2]) + (z1[far] - z1[near]) * np.cos(road.at(s[near])[2])
        keep = (ahead0 > 0.02) & (ahead1 > 0.02)
        outside = np.ones(rows, bool)
        if keep_off is not None:
            outside = self.off_road((x0[near] + x1[far]) / 2, (z0[near] + z1[far]) / 2,
                                    parked=road is not self.track) > keep_off
        u_width = 1.0 if whole_width else (d1 - d0) / tile_u
        u0 = 0.0 if whole_width else d0 / tile_u
        v, v_step = s / tile_v, step / tile_v
        cells = np.zeros((rows, render.COLUMNS))
        # Where a street meets itself its later part lies a little lower, or the two would flicker.
        y = y + LAYER / 100 * ((s[near] - road.s[0]) % 500)
        cells[:, 0], cells[:, 1], cells[:, 2] = x0[near], y, z0[near]
        cells[:, 3], cells[:, 5] = x1[near] - x0[near], z1[near] - z0[near]
        cells[:, 6], cells[:, 8] = x0[far] - x0[near], z0[far] - z0[near]
        cells[:, 9], cells[:, 10], cells[:, 12], cells[:, 14] = u0, u_width, -v[near], -v_step
        cells[:, render.TEXTURE], cells[:, render.LABEL] = self.names[texture], ID[label]
        cells[:, render.GAIN], cells[:, render.GROUND], cells[:, render.LIT] = 1.0, ground, 1
        bent = ~(straight[near] & straight[far])
        cells[:, render.TRIANGLE] = bent
        other = cells.copy()
        other[:, 0], other[:, 2] = x1[far], z1[far]
        other[:, 3], other[:, 5] = x0[far] - x1[far], z0[far] - z1[far]
        other[:, 6], other[:, 8] = x1[near] - x1[far], z1[near] - z1[far]
        other[:, 9], other[:, 10], other[:, 12], other[:, 14] = u0 + u_width, -u_width, -v[far], v_step
        for part, shown in ((cells, keep), (other, keep & bent)):
            self.parts.append(part[shown & outside])
            asphalt = part[shown & ~outside]  # the gap between two roads that meet
            asphalt[:, 1] = 0.04
            asphalt[:, render.TEXTURE], asphalt[:, render.LABEL] = self.names["asphalt"], ID["road"]
            asphalt[:, 9:15] *= (tile_u / TILE["asphalt"][0],) * 3 + (tile_v / TILE["asphalt"][1],) * 3
            asphalt[:, render.GROUND] = ROAD
            self.parts.append(asphalt)

    def _mover(self, track, s, pace, d, turn, kind=None):
        kind = kind or str(self.rng.choice(["sedan", "hatch", "estate", "van", "truck", "bus"],
                                           p=[0.32, 0.3, 0.2, 0.1, 0.05, 0.03]))
        self.movers.append(Mover(self.any_vehicle(kind), track, s, pace, d, turn))

    def any_vehicle(self, kind):
        paint = int(self.rng.choice([0, 2])) if kind in ("truck", "bus") else int(self.rng.integers(0, 6))
        return vehicle(self.names, kind, paint)

    def ground(self):
        style = self.style
        for index, (road, half) in enumerate(self.roads):
            lower = LAYER * index
            texture = style.road if index == 0 else "lane"
            self.strip(road, road.s[0], road.s[-1], -half, half, lower, texture, "road", ROAD, whole_width=True)
            if style.road == "highway":
                continue
            for side in (-1, 1):
                edge = half
                lane = style.parking[(side + 1) // 2] if index == 0 else 0.0
                if lane:
                    self.band(road, side, edge, edge + lane, lower, "parking", "parking", ROAD, -0.05)
                    edge += lane
                self.band(road, side, edge, edge + 0.15, lower - KERB - 0.002, "kerb", "sidewalk", SIDEWALK, 0.0)
                self.riser(road, side, edge)
                self.band(road, side, edge + 0.15, edge + style.sidewalk, lower - KERB, "sidewalk",
                          "sidewalk", SIDEWALK, 0.1)
        reach = 60.0
        size = 30.0
        cells = set()
        for x, z in self.middle[::8]:
            for i in range(int((x - reach) // size), int((x + reach) // size) + 1):
                for j in range(int((z - reach) // size), int((z + reach) // size) + 1):
                    cells.add((i, j))
        faces = Faces(self.names)
        tile = TILE["grass"][0]
        for i, j in sorted(cells):
            faces.add((i * size, 0.06, j * size), (size, 0, 0), (0, 0, size), "grass", "terrain",
                      (size / tile, size / tile), ground=ROAD, casts=0)
        for road, half in self.roads[1:]:  # no grass between the bends of a junction
            reach = half + 4.0
            x, z, heading = road.at(0.0)
            corner = np.array([x, 0.05, z]) - reach * np.array([np.cos(heading) + np.sin(heading), 0,
                                                                np.cos(heading) - np.sin(heading)])
            faces.add(corner, 2 * reach * np.array([np.cos(heading), 0, -np.sin(heading)]),
                      2 * reach * np.array([np.sin(heading), 0, np.cos(heading)]), "asphalt", "road",
                      (2 * reach / 12, 2 * reach / 12), ground=ROAD, casts=0)
        self.parts.append(faces.matrix())

    def band(self, road, side, near, far, y, texture, label, ground, keep_off, s_range=None):
        d0, d1 = (near, far) if side > 0 else (-far, -near)
        s_from, s_to = s_range or (road.s[0], road.s[-1])
        self.strip(road, s_from, s_to, d0, d1, y, texture, label, ground, keep_off)

    def riser(self, road, side, edge):
        s = np.arange(road.s[0], road.s[-1], 2.0)
        x, z, _ = road.at(s, side * edge)
        keep = self.off_road((x[1:] + x[:-1]) / 2, (z[1:] + z[:-1]) / 2, parked=road is not self.track) > -0.05
        faces = Faces(self.names)
        for k in np.flatnonzero(keep):
            a, b = (k, k + 1) if side < 0 else (k + 1, k)
            faces.add((x[b], 0.0, z[b]), (x[a] - x[b], 0, z[a] - z[b]), (0, -KERB, 0), "kerb", "sidewalk",
                      uv=(0.1, 0, 0.3, s[k] / 8, 0.25, 0), casts=0, gain=0.8)
        self.parts.append(faces.matrix())

    def edge(self, side, road_index=0):
        """Distance of the building line from the road's middle."""
        style = self.style
        half = self.roads[road_index][1]
        if style.road == "highway":
            return half + 3.0
        return half + (style.parking[(side + 1) // 2] if road_index == 0 else 0.0) + style.sidewalk

    def sides(self):
        rng, style = self.rng, self.style
        for index, (road, _) in enumerate(self.roads):
            for side in (-1, 1):
                s = road.s[0]
                while s < road.s[-1] - 5:
                    length = min(rng.uniform(24, 60), road.s[-1] - s)
                    zone = str(rng.choice(style.zones, p=style.weights))
                    getattr(self, f"_zone_{zone}")(road, index, side, s, s + length)
                    s += length
        if style.road == "highway":
            self._highway()
        else:
            for side in (-1, 1):
                self._furniture(side)

    def _house_row(self, road, index, side, s0, s1, gap, setback, floors, pitched):
        rng = self.rng
        s = s0
        while s < s1 - 6:
            width, depth = min(rng.uniform(9, 17), s1 - s), rng.uniform(8, 12)
            if width < 6:
                break
            distance = self.edge(side, index) + setback * rng.uniform(0.8, 1.3) + 0.05
            x, z, heading = road.at(s + width / 2, side * distance)
            yaw = heading + side * np.pi / 2
            footprint = Footprint(x, z, yaw, width / 2, depth)
            px, pz = footprint.points()
            if self.off_road(px, pz).min() > min(1.8, self.style.sidewalk) and not any(
                    b.overlaps(footprint) for b in self.buildings):
                faces = building(self.names, rng, width, depth, int(rng.integers(*floors)), rng.random() < pitched)
                self.put(faces, x, z, yaw)
                self.buildings.append(footprint)
            s += width + (rng.uniform(*gap) if gap else 0.02)

    def _yard(self, road, index, side, s0, s1, texture, label, depth=14.0):
        edge = self.edge(side, index)
        self.band(road, side, edge, edge + depth, LAYER * index - KERB + 0.02, texture, label, SIDEWALK, 1.0,
                  (s0, s1))

    def _line(self, road, side, s0, s1, distance, texture, label, height, step=3.0, y=-KERB, margin=0.8, casts=1):
        """An upright band along the road, as a fence or a guard rail."""
        faces = Faces(self.names)
        tile = TILE[texture][0]
        s = np.arange(s0, s1 + 0.01, step)
        x, z, _ = road.at(s, side * distance)
        for k in range(len(s) - 1):
            if self.off_road((x[k] + x[k + 1]) / 2, (z[k] + z[k + 1]) / 2)[0] > margin:
                a, b = (k, k + 1) if side < 0 else (k + 1, k)
                faces.add((x[b], y, z[b]), (x[a] - x[b], 0, z[a] - z[b]), (0, -height, 0), texture, label,
                          uv=(s[k] / tile, step / tile, 0, 1, 0, -1), casts=casts)
        self.parts.append(faces.matrix())

    def _solid(self, road, side, s0, s1, distance, thickness, texture, label, height, step=4.0, lit=True):
        """A wall or hedge along the road, box by box."""
        s = np.arange(s0, s1 - step / 2, step)
        tile = TILE[texture][0]
        for start in s:
            x, z, heading = road.at(start + step / 2, side * distance)
            if not self.free(x, z, 1.2):
                continue
            faces = Faces(self.names)
            faces.box((0, thickness), (-height, 0), (-step / 2 - 0.03, step / 2 + 0.03), texture, label, tile)
            matrix = faces.matrix()
            matrix[:, render.LIT] = lit
            # Neighbouring boxes show different parts of the texture.
            matrix[:, 9] += start / tile
            self.put(matrix, x, z, heading if side > 0 else heading + np.pi)

    def _tree(self, x, z, height=None, kind=None):
        rng = self.rng
        kind = int(rng.integers(0, TREES)) if kind is None else kind
        height = height or rng.uniform(5, 9.5)
        self.put(cut_out(self.names, f"tree{kind}", "vegetation", height * rng.uniform(0.85, 1.05), height, True,
                         rng.uniform(0.85, 1.2)), x, z, rng.uniform(0, np.pi))

    def _scatter(self, road, index, side, s0, s1, near, far, density, what):
        for _ in range(int((s1 - s0) * density) + 1):
            s, d = self.rng.uniform(s0, s1), self.edge(side, index) + self.rng.uniform(near, far)
            x, z, _ = road.at(s, side * d)
            if not self.free(x, z, 2.0):
                continue
            if what == "bush":
                width = self.rng.uniform(1.4, 3.0)
                self.put(cut_out(self.names, f"bush{self.rng.integers(0, 2)}", "vegetation", width, width * 0.55, True),
                         x, z, self.rng.uniform(0, np.pi))
            else:
                self._tree(x, z)

    def _zone_blocks(self, road, index, side, s0, s1):
        self._yard(road, index, side, s0, s1, "gravel", "ground")
        self._house_row(road, index, side, s0, s1, None, 0.0, (1, 5), 0.5)

    def _zone_houses(self, road, index, side, s0, s1):
        rng = self.rng
        self._yard(road, index, side, s0, s1, "grass", "terrain")
        self._house_row(road, index, side, s0, s1, (2, 6), 4.0, (0, 3), 0.85)
        border = str(rng.choice(["picket", "wire", "hedge", "stone"]))
        edge = self.edge(side, index) + 0.15
        if border in ("picket", "wire"):
            self._line(road, side, s0, s1 - 3, edge, border, "fence", TILE[border][1])
        elif border == "hedge":
            self._solid(road, side, s0, s1 - 4, edge, 0.7, "hedge", "vegetation", rng.uniform(1.0, 1.7), lit=False)
        else:
            self._solid(road, side, s0, s1 - 4, edge, 0.3, "stone", "wall", rng.uniform(0.8, 1.2))
        self._scatter(road, index, side, s0, s1, 1.0, 3.0, 0.08, "bush")
        self._scatter(road, index, side, s0, s1, 1.5, 12.0, 0.05, "tree")

    def _zone_park(self, road, index, side, s0, s1):
        self._yard(road, index, side, s0, s1, "grass", "terrain", 30.0)
        self._scatter(road, index, side, s0, s1, 1.0, 26.0, 0.35, "tree")
        self._scatter(road, index, side, s0, s1, 0.6, 12.0, 0.2, "bush")
        if self.rng.random() < 0.4:
            self._line(road, side, s0, s1 - 3, self.edge(side, index) + 0.15, "wire", "fence", 1.3)

    def _zone_wall(self, road, index, side, s0, s1):
        self._yard(road, index, side, s0, s1, "gravel", "ground")
        texture = str(self.rng.choice(["stone", "concrete"]))
        self._solid(road, side, s0, s1 - 4, self.edge(side, index) + 0.1, 0.35, texture, "wall",
                    self.rng.uniform(1.8, 2.6))
        self._scatter(road, index, side, s0, s1, 2.0, 12.0, 0.15, "tree")

    def _zone_field(self, road, index, side, s0, s1):
        self._yard(road, index, side, s0, s1, "grass", "terrain", 30.0)
        self._scatter(road, index, side, s0, s1, 8.0, 40.0, 0.15, "tree")
        self._scatter(road, index, side, s0, s1, 3.0, 20.0, 0.1, "bush")

    def _highway(self):
        rng, track, style = self.rng, self.track, self.style
        for side in (-1, 1):
            self._line(track, side, track.s[0], track.s[-1], style.half + 0.7, "rail", "guard rail", 0.8, 4.0, 0.0, 0.3)
            s = track.s[0] + rng.uniform(5, 20)
            while s < track.s[-1] - 10:
                x, z, heading = track.at(s, side * (style.half + 2.2))
                if rng.random() < 0.5:
                    self.put(sign(self.names, 5, rng.uniform(1.6, 2.6), 2.2, 0.06), x, z, heading, 0.0)
                else:
                    self.put(lamp(self.names, 9.0, 2.5), x, z, heading + (0 if side < 0 else np.pi), 0.0)
                s += rng.uniform(25, 55)
        for k in range(int((track.s[-1] - track.s[0]) / 28)):
            lane = (-4.6, 0.0, 4.6)[k % 3]
            s = 25.0 + 26.0 * k + rng.uniform(-6, 6)
            self._mover(track, s if lane else s + 35, rng.uniform(1.35, 1.75), lane, 0.0)
        if style.bridge >= 0:
            x, z, heading = track.at(style.bridge)
            faces = Faces(self.names)
            faces.box((-30, 30), (-7.0, -5.6), (-4, 4), "concrete", "bridge", 8.0, gain=0.85)
            for pillar in (-style.half - 2.5, style.half + 1.5):
                faces.box((pillar, pillar + 1.0), (-5.6, 0.06), (-3, 3), "concrete", "bridge", 8.0, gain=0.8)
            self.put(faces.matrix(), x, z, heading, 0.0)

    def _furniture(self, side):
        """What stands on the sidewalk and at the kerb of the main road, and what moves there."""
        rng, style, track = self.rng, self.style, self.track
        lane = style.parking[(side + 1) // 2]
        kerb = style.half + lane
        front = 0.0 if side > 0 else np.pi

        def along(step):
            s = track.s[0] + rng.uniform(0, step)
            while s < track.s[-1] - 3:
                yield s
                s += step * rng.uniform(0.75, 1.35)

        for s in along(26.0):
            x, z, heading = track.at(s, side * (kerb + 0.45))
            if self.free(x, z, 0.3):
                self.put(lamp(self.names, rng.uniform(5, 7), 1.4), x, z, heading + (np.pi if side > 0 else 0.0))
        if style.trees:
            for s in along(9.0 / style.trees):
                x, z, _ = track.at(s, side * (kerb + 0.8))
                if self.free(x, z, 0.6):
                    self._tree(x, z, rng.uniform(4.5, 7.5), int(rng.integers(0, 4)))
        for s in along(21.0):
            x, z, heading = track.at(s, side * (kerb + 0.5))
            if self.free(x, z, 0.3):
                kind = int(rng.integers(0, SIGNS))
                size = rng.uniform(0.6, 0.8) if kind < 5 else rng.uniform(0.9, 1.3)
                self.put(sign(self.names, kind, size, rng.uniform(1.9, 2.4)), x, z,
                         heading + (0.0 if side > 0 else np.pi) + rng.uniform(-0.15, 0.15))
        for s in along(17.0):
            x, z, heading = track.at(s, side * (kerb + style.sidewalk - 0.35))
            if not self.free(x, z, 0.8):
                continue
            what = rng.integers(0, 4)
            faces = Faces(self.names)
            if what == 0:
                faces.box((-0.3, 0.3), (-1.05, 0), (-0.3, 0.3), "bin", "dynamic", 0.6)
            elif what == 1:
                faces.box((-0.25, 0.25), (-0.5, -0.4), (-0.9, 0.9), "wood", "static", 2.0)
                faces.box((-0.2, 0.2), (-0.4, 0), (-0.7, -0.6), "metal", "static", 2.0)
                faces.box((-0.2, 0.2), (-0.4, 0), (0.6, 0.7), "metal", "static", 2.0)
            elif what == 2:
                faces.add((0, 0, -0.9), (0, 0, 1.8), (0, -1.05, 0), "bicycle", "bicycle", lit=0)
            else:
                faces.box((-0.4, 0.4), (-1.3, 0), (-0.2, 0.2), "concrete", "static", 2.0, gain=0.8)
            self.put(faces.matrix(), x, z, heading + rng.uniform(-0.1, 0.1))
        for _ in range(int((track.s[-1] - track.s[0]) * style.persons)):
            s, d = rng.uniform(track.s[0], track.s[-1]), kerb + rng.uniform(0.6, style.sidewalk - 0.3)
            x, z, heading = track.at(s, side * d)
            if self.free(x, z, 0.5):
                height = rng.uniform(1.6, 1.9)
                faces = place(cut_out(self.names, f"person{rng.integers(0, PERSONS)}", "person", height / 2, height),
                              0.0, 0.0, 0.0, -KERB)
                pace = float(rng.choice([0.0, 0.12, -0.12]))
                self.movers.append(Mover(faces, track, s, pace, side * d, rng.uniform(-0.5, 0.5)))
        if lane:
            s = track.s[0] + rng.uniform(0, 6)
            while s < track.s[-1] - 6:
                x, z, heading = track.at(s, side * (style.half + lane / 2))
                kind = str(rng.choice(["sedan", "hatch", "estate", "van", "truck"], p=[0.33, 0.33, 0.22, 0.1, 0.02]))
                if rng.random() < style.parked and self.off_road(x, z)[0] > 0.3:
                    self.put(self.any_vehicle(kind), x, z, heading + front + rng.normal(0, 0.02), 0.0)
                s += {"van": 6.6, "truck": 9.5}.get(kind, 5.8) + rng.exponential(0.5)
        for corner in [*track.corners, *([style.crossing] if style.crossing >= 0 else [])]:
            x, z, heading = track.at(corner - 7.0, side * (kerb + 0.4))
            if self.free(x, z, 0.2):
                self.put(traffic_light(self.names), x, z, heading)
        if side < 0:  # oncoming
            for s in along(1 / max(style.traffic, 1e-4)):
                self._mover(track, s + 40, -rng.uniform(0.7, 1.1), -style.half / 2, np.pi)
        elif style.leader:
            self._mover(track, style.leader, FOLLOWS, style.half / 2, 0.0, "estate")
        if side < 0 and rng.random() < 0.7:
            self.movers.append(Mover(cyclist(self.names), track, rng.uniform(25, 60), -0.35, 0.5 - style.half, front))

def _sky(rng, style):
    environment = np.zeros(render.ENVIRONMENT)
    azimuth, elevation = style.sun if style.sunny else (style.sun[0], 1.35)
    environment[:3] = (-np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth))
    # Under clouds the light comes from above and shadows are faint pools under things.
    environment[render.AMBIENT], environment[render.DIRECT], environment[render.SHADOW] = (
        (0.36, 0.86, 0.36) if style.sunny else (0.70, 0.30, 0.62))
    environment[render.ZENITH], environment[render.HORIZON], environment[render.CLOUDS] = style.sky
    environment[render.HAZE] = style.haze
    columns = 2048
    skyline = np.maximum(0.0, 0.035 + 0.022 * noise(rng, (8, columns), 256, 5)[0])
    labels = np.full(columns, ID["vegetation"], np.uint8)
    for _ in range(int(rng.integers(3, 9))):  # distant houses
        left, width = int(rng.integers(0, columns - 60)), int(rng.integers(12, 50))
        skyline[left:left + width] = rng.uniform(0.04, 0.09)
        labels[left:left + width] = ID["building"]
    return environment, skyline.astype(np.float64), labels


def build(rng, bank, track, style):
    """Lay out a street along `track`; `bank` is what textures.build returned."""
    builder = _Builder(rng, bank, track, style)
    builder.ground()
    builder.sides()
    environment, horizon, horizon_labels = _sky(rng, style)
    return Street(bank, track, style, np.ascontiguousarray(np.concatenate(builder.parts)), builder.movers, environment,
                  horizon, horizon_labels)
