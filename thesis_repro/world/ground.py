"""The ground of a street: roads, parking lanes, kerbs and sidewalks as bands along the tracks, and the grass around."""

import numpy as np

from thesis_repro.cityscapes import ID
from thesis_repro.world.faces import Faces, rows
from thesis_repro.world.raster import CORNER, GROUND, LABEL, ROAD, SIDEWALK, TEXTURE, U, V, X, Y, Z
from thesis_repro.world.street import KERB, LAYER
from thesis_repro.world.surfaces import TILE


def lay(plan):
    """Add the whole ground to a plan, less the yards, which belong to what stands on them."""
    for road in plan.roads:
        _roadway(plan, road)
        if plan.style.road != "highway":
            for side in (-1, 1):
                _sidewalk(plan, road, side)
    faces = Faces(plan.names)
    _meadow(plan, faces)
    for road in plan.roads[1:]:
        _junction(road, faces)
    plan.parts.append(faces.matrix())


def band(plan, road, side, near, far, y, texture, label, ground, keep_off, span=None):
    """Add a band of ground beside a road, from `near` to `far` metres off its middle.

    ground: its level; keep_off: metres to other roads, where asphalt takes its place; span: (s, s) of its ends, or the
    whole road.
    """
    track, (tile_u, tile_v) = road.track, TILE[texture]
    start, stop = span or (track.s[0], track.s[-1])
    d0, d1 = (near, far) if side > 0 else (-far, -near)
    s = np.arange(start, stop + 0.5, 1.0)
    if len(s) < 2:
        return
    ribbon = _ribbon(plan, track, s, 1.0, d0, d1, y, (d0 / tile_u, (d1 - d0) / tile_u), texture, label, ground)
    (cells, _), (others, _) = ribbon
    outside = plan.off_road((cells[:, CORNER + X] + others[:, CORNER + X]) / 2,
                            (cells[:, CORNER + Z] + others[:, CORNER + Z]) / 2,
                            parked=road is not plan.main) > keep_off
    for faces, shown in ribbon:
        plan.parts.append(faces[shown & outside])
        gap = faces[shown & ~outside]  # between two roads that meet
        gap[:, CORNER + Y] = 0.04
        gap[:, TEXTURE], gap[:, LABEL], gap[:, GROUND] = plan.names["asphalt"], ID["road"], ROAD
        gap[:, U:U + 3] *= tile_u / TILE["asphalt"][0]
        gap[:, V:V + 3] *= tile_v / TILE["asphalt"][1]
        plan.parts.append(gap)


def _roadway(plan, road):
    s = np.arange(road.track.s[0], road.track.s[-1] + 1.0, 2.0)
    texture = plan.style.road if road is plan.main else "lane"  # its markings take the whole width
    plan.parts += [faces[shown] for faces, shown in _ribbon(
        plan, road.track, s, 2.0, -road.half, road.half, road.lower, (0.0, 1.0), texture, "road", ROAD)]


def _ribbon(plan, track, s, step, d0, d1, y, u, texture, label, ground):
    """The faces of a band between d0 < d1 with its knots at s, `step` apart; u: at d0, and what d1 has more.

    Returns [(cells, shown), (others, shown)], one row each for every pair of knots: a parallelogram where the track is
    straight, and two triangles where it bends, the second one in `others`.
    """
    x0, z0, _ = track.at(s, d0)
    x1, z1, _ = track.at(s, d1)
    near, far = slice(0, -1), slice(1, None)
    heading = track.at(s[near])[2]
    # Inside a tight bend the band would fold over.
    shown = np.ones(len(s) - 1, bool)
    for x, z in ((x0, z0), (x1, z1)):
        shown &= (x[far] - x[near]) * np.sin(heading) + (z[far] - z[near]) * np.cos(heading) > 0.02
    straight = np.abs(np.interp(s, track.s, track.curvature)) < 1e-6
    bent = ~(straight[near] & straight[far])
    v, v_step = s / TILE[texture][1], step / TILE[texture][1]
    # Where a street meets itself its later part lies a little lower, or the two would flicker.
    y = y + LAYER / 100 * ((s[near] - track.s[0]) % 500)
    level = np.zeros(len(y))
    cells = rows(corner=np.stack([x0[near], y, z0[near]], axis=1),
                 edge_s=np.stack([x1[near] - x0[near], level, z1[near] - z0[near]], axis=1),
                 edge_t=np.stack([x0[far] - x0[near], level, z0[far] - z0[near]], axis=1),
                 uv=(u[0], u[1], 0, -v[near], 0, -v_step),
                 texture=plan.names[texture], label=ID[label], ground=ground, triangle=bent)
    others = rows(corner=np.stack([x1[far], y, z1[far]], axis=1),
                  edge_s=np.stack([x0[far] - x1[far], level, z0[far] - z1[far]], axis=1),
                  edge_t=np.stack([x1[near] - x1[far], level, z1[near] - z1[far]], axis=1),
                  uv=(u[0] + u[1], -u[1], 0, -v[far], 0, v_step),
                  texture=plan.names[texture], label=ID[label], ground=ground, triangle=bent)
    return [(cells, shown), (others, shown & bent)]


def _sidewalk(plan, road, side):
    """Parking lane, kerb and sidewalk on one side of a road."""
    edge = road.half + road.lane(side)
    if road.lane(side):
        band(plan, road, side, road.half, edge, road.lower, "parking", "parking", ROAD, -0.05)
    band(plan, road, side, edge, edge + 0.15, road.lower - KERB - 0.002, "kerb", "sidewalk", SIDEWALK, 0.0)
    _riser(plan, road, side, edge)
    band(plan, road, side, edge + 0.15, edge + plan.style.sidewalk, road.lower - KERB, "sidewalk", "sidewalk", SIDEWALK,
         0.1)


def _riser(plan, road, side, edge):
    """The upright side of a kerb."""
    s = np.arange(road.track.s[0], road.track.s[-1], 2.0)
    x, z, _ = road.track.at(s, side * edge)
    keep = plan.off_road((x[1:] + x[:-1]) / 2, (z[1:] + z[:-1]) / 2, parked=road is not plan.main) > -0.05
    faces = Faces(plan.names)
    for k in np.flatnonzero(keep):
        a, b = (k, k + 1) if side < 0 else (k + 1, k)
        faces.add((x[b], 0.0, z[b]), (x[a] - x[b], 0, z[a] - z[b]), (0, -KERB, 0), "kerb", "sidewalk",
                  uv=(0.1, 0, 0.3, s[k] / 8, 0.25, 0), casts=0, gain=0.8)
    plan.parts.append(faces.matrix())


def _meadow(plan, faces):
    """Squares of grass under everything within 60 m of a road."""
    reach, size = 60.0, 30.0
    squares = set()
    for x, z in plan.middle[::8]:
        for i in range(int((x - reach) // size), int((x + reach) // size) + 1):
            for j in range(int((z - reach) // size), int((z + reach) // size) + 1):
                squares.add((i, j))
    repeats = size / TILE["grass"][0]
    for i, j in sorted(squares):
        faces.add((i * size, 0.06, j * size), (size, 0, 0), (0, 0, size), "grass", "terrain", (repeats, repeats),
                  ground=ROAD, casts=0)


def _junction(road, faces):
    """A square of asphalt where a road leaves the main one: no grass between the bends of a junction."""
    reach = road.half + 4.0
    x, z, heading = road.track.at(0.0)
    corner = np.array([x, 0.05, z]) - reach * np.array([np.cos(heading) + np.sin(heading), 0,
                                                        np.cos(heading) - np.sin(heading)])
    faces.add(corner, 2 * reach * np.array([np.cos(heading), 0, -np.sin(heading)]),
              2 * reach * np.array([np.sin(heading), 0, np.cos(heading)]), "asphalt", "road",
              (2 * reach / 12, 2 * reach / 12), ground=ROAD, casts=0)
