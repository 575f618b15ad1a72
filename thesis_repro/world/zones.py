"""What lies beside the roads, stretch by stretch: blocks of houses, gardens, parks, walls and fields."""

from typing import NamedTuple

import numpy as np

from thesis_repro.world.faces import Faces
from thesis_repro.world.ground import band
from thesis_repro.world.props import Footprint, building, bush, tree
from thesis_repro.world.raster import LIT, SIDEWALK, U
from thesis_repro.world.street import KERB, Road
from thesis_repro.world.surfaces import TILE


class Lot(NamedTuple):
    """A stretch beside a road, from the building line outwards."""

    road: Road
    side: int
    start: float  # s of its ends
    stop: float


def build_up(plan):
    """Divide both sides of all roads into lots and fill each with a zone of the plan's style."""
    for road in plan.roads:
        for side in (-1, 1):
            s, end = road.track.s[0], road.track.s[-1]
            while s < end - 5:
                length = min(plan.rng.uniform(24, 60), end - s)
                zone = str(plan.rng.choice(plan.style.zones, p=plan.style.weights))
                ZONES[zone](plan, Lot(road, side, s, s + length))
                s += length


def _blocks(plan, lot):
    _yard(plan, lot, "gravel", "ground")
    _house_row(plan, lot, None, 0.0, (1, 5), 0.5)


def _houses(plan, lot):
    rng = plan.rng
    _yard(plan, lot, "grass", "terrain")
    _house_row(plan, lot, (2, 6), 4.0, (0, 3), 0.85)
    border = str(rng.choice(["picket", "wire", "hedge", "stone"]))
    if border in ("picket", "wire"):
        _garden_fence(plan, lot, border, TILE[border][1])
    elif border == "hedge":
        _wall(plan, lot, 0.15, 0.7, "hedge", "vegetation", rng.uniform(1.0, 1.7), lit=0)
    else:
        _wall(plan, lot, 0.15, 0.3, "stone", "wall", rng.uniform(0.8, 1.2))
    _scatter(plan, lot, 1.0, 3.0, 0.08, bush)
    _scatter(plan, lot, 1.5, 12.0, 0.05, tree)


def _park(plan, lot):
    _yard(plan, lot, "grass", "terrain", 30.0)
    _scatter(plan, lot, 1.0, 26.0, 0.35, tree)
    _scatter(plan, lot, 0.6, 12.0, 0.2, bush)
    if plan.rng.random() < 0.4:
        _garden_fence(plan, lot, "wire", 1.3)


def _walled(plan, lot):
    _yard(plan, lot, "gravel", "ground")
    texture = str(plan.rng.choice(["stone", "concrete"]))
    _wall(plan, lot, 0.1, 0.35, texture, "wall", plan.rng.uniform(1.8, 2.6))
    _scatter(plan, lot, 2.0, 12.0, 0.15, tree)


def _field(plan, lot):
    _yard(plan, lot, "grass", "terrain", 30.0)
    _scatter(plan, lot, 8.0, 40.0, 0.15, tree)
    _scatter(plan, lot, 3.0, 20.0, 0.1, bush)


ZONES = {"blocks": _blocks, "houses": _houses, "park": _park, "wall": _walled, "field": _field}


def _yard(plan, lot, texture, label, depth=14.0):
    line = plan.building_line(lot.road, lot.side)
    band(plan, lot.road, lot.side, line, line + depth, lot.road.lower - KERB + 0.02, texture, label, SIDEWALK, 1.0,
         (lot.start, lot.stop))


def _house_row(plan, lot, gap, setback, floors, pitched):
    """Houses side by side where there is room; gap: (least, most) metres between them, None for none.

    setback: metres behind the building line, about; floors: (least, one more than most); pitched: part of the roofs.
    """
    rng, s = plan.rng, lot.start
    while s < lot.stop - 6:
        width, depth = min(rng.uniform(9, 17), lot.stop - s), rng.uniform(8, 12)
        if width < 6:
            break
        distance = plan.building_line(lot.road, lot.side) + setback * rng.uniform(0.8, 1.3) + 0.05
        x, z, heading = lot.road.track.at(s + width / 2, lot.side * distance)
        yaw = heading + lot.side * np.pi / 2
        footprint = Footprint(x, z, yaw, width / 2, depth)
        if plan.off_road(*footprint.points).min() > min(1.8, plan.style.sidewalk) and not any(
                other.overlaps(footprint) for other in plan.buildings):
            faces = building(plan.names, rng, width, depth, int(rng.integers(*floors)), rng.random() < pitched)
            plan.put(faces, x, z, yaw)
            plan.buildings.append(footprint)
        s += width + (rng.uniform(*gap) if gap else 0.02)


def fence(plan, track, side, start, stop, step, distance, texture, label, height, y=-KERB, margin=0.8):
    """Put up an upright band along a track, as a fence or a guard rail, in pieces of `step` metres.

    distance: from the track; y: of its foot; margin: metres that it keeps off all roads.
    """
    faces = Faces(plan.names)
    tile = TILE[texture][0]
    s = np.arange(start, stop + 0.01, step)
    x, z, _ = track.at(s, side * distance)
    for k in range(len(s) - 1):
        if plan.off_road((x[k] + x[k + 1]) / 2, (z[k] + z[k + 1]) / 2)[0] > margin:
            a, b = (k, k + 1) if side < 0 else (k + 1, k)
            faces.add((x[b], y, z[b]), (x[a] - x[b], 0, z[a] - z[b]), (0, -height, 0), texture, label,
                      uv=(s[k] / tile, step / tile, 0, 1, 0, -1))
    plan.parts.append(faces.matrix())


def _garden_fence(plan, lot, texture, height):
    fence(plan, lot.road.track, lot.side, lot.start, lot.stop - 3, 3.0,
          plan.building_line(lot.road, lot.side) + 0.15, texture, "fence", height)


def _wall(plan, lot, setback, thickness, texture, label, height, lit=1):
    """A wall or hedge along the building line, box by box where there is room."""
    length, tile = 4.0, TILE[texture][0]
    distance = plan.building_line(lot.road, lot.side) + setback
    for start in np.arange(lot.start, lot.stop - 4 - length / 2, length):
        x, z, heading = lot.road.track.at(start + length / 2, lot.side * distance)
        ends_x, ends_z, _ = lot.road.track.at(start + np.array([0.0, length]), lot.side * distance)
        half = np.hypot(np.diff(ends_x)[0], np.diff(ends_z)[0]) / 2 + 0.05  # longer outside a bend
        if not plan.free(x, z, 1.2):
            continue
        faces = Faces(plan.names)
        faces.box((0, thickness), (-height, 0), (-half, half), texture, label, tile)
        matrix = faces.matrix()
        matrix[:, LIT] = lit
        matrix[:, U] += start / tile  # neighbouring boxes show different parts of the texture
        plan.put(matrix, x, z, heading if lot.side > 0 else heading + np.pi)


def _scatter(plan, lot, near, far, density, plant):
    """Trees or bushes, so many for each metre of the lot, from `near` to `far` metres behind the building line."""
    for _ in range(int((lot.stop - lot.start) * density) + 1):
        s = plan.rng.uniform(lot.start, lot.stop)
        d = plan.building_line(lot.road, lot.side) + plan.rng.uniform(near, far)
        x, z, _ = lot.road.track.at(s, lot.side * d)
        if plan.free(x, z, 2.0):
            plan.put(plant(plan.names, plan.rng), x, z, plan.rng.uniform(0, np.pi))
