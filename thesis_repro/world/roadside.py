"""What stands beside the carriageway and on the sidewalks of the main road, and what parks and drives there."""

import numpy as np

from thesis_repro.world.faces import Faces, place
from thesis_repro.world.props import cut_out, cyclist, lamp, sign, traffic_light, tree, vehicle
from thesis_repro.world.sprites import PERSONS, SIGNS
from thesis_repro.world.street import KERB, Mover
from thesis_repro.world.zones import fence

_TRAFFIC = {"sedan": 0.32, "hatch": 0.3, "estate": 0.2, "van": 0.1, "truck": 0.05, "bus": 0.03}
_PARKED = {"sedan": 0.33, "hatch": 0.33, "estate": 0.22, "van": 0.1, "truck": 0.02}
_SLOTS = {"van": 6.6, "truck": 9.5}  # metres that a parked vehicle takes, others 5.8


def furnish(plan):
    """Add all this to a plan whose buildings stand."""
    if plan.style.road == "highway":
        for side in (-1, 1):
            _highway_side(plan, side)
        _highway_traffic(plan)
        if plan.style.bridge is not None:
            _bridge(plan)
        return
    for side in (-1, 1):
        _lamps(plan, side)
        if plan.style.trees:
            _trees(plan, side)
        _signs(plan, side)
        _oddments(plan, side)
        _persons(plan, side)
        if plan.main.lane(side):
            _parked(plan, side)
        _traffic_lights(plan, side)
        _traffic(plan, side)


def crossing_traffic(plan, track):
    """Cars on a road that crosses the main one, from both sides in turn."""
    for k in range(14):
        side = 1 if k % 2 else -1
        s = -side * (12.0 + 13.0 * k + plan.rng.uniform(-3, 3))
        _drive(plan, track, s, side * plan.rng.uniform(0.6, 0.75), 1.7 * side, 0.0 if side > 0 else np.pi)


def _drive(plan, track, s, pace, d, turn, kind=None):
    """Let a vehicle drive along a track; without a kind, any."""
    kind = kind or _any(plan.rng, _TRAFFIC)
    plan.movers.append(Mover(vehicle(plan.names, plan.rng, kind), track, s, pace, d, turn))


def _any(rng, shares):
    return str(rng.choice(list(shares), p=list(shares.values())))


def _along(plan, step):
    """Places along the main road, about `step` metres apart."""
    s = plan.main.track.s[0] + plan.rng.uniform(0, step)
    while s < plan.main.track.s[-1] - 3:
        yield s
        s += step * plan.rng.uniform(0.75, 1.35)


def _kerb(plan, side):
    """Distance of the kerb from the middle of the main road."""
    return plan.main.half + plan.main.lane(side)


def _ahead(side):
    """What turns a thing so that it looks the way one drives on that side of the road (radians)."""
    return 0.0 if side > 0 else np.pi


def _lamps(plan, side):
    for s in _along(plan, 26.0):
        x, z, heading = plan.main.track.at(s, side * (_kerb(plan, side) + 0.45))
        if plan.free(x, z, 0.3):
            plan.put(lamp(plan.names, plan.rng.uniform(5, 7), 1.4), x, z, heading + (np.pi if side > 0 else 0.0))


def _trees(plan, side):
    for s in _along(plan, 9.0 / plan.style.trees):
        x, z, _ = plan.main.track.at(s, side * (_kerb(plan, side) + 0.8))
        if plan.free(x, z, 0.6):
            faces = tree(plan.names, plan.rng, plan.rng.uniform(4.5, 7.5), int(plan.rng.integers(0, 4)))  # no conifer
            plan.put(faces, x, z, plan.rng.uniform(0, np.pi))


def _signs(plan, side):
    rng = plan.rng
    for s in _along(plan, 21.0):
        x, z, heading = plan.main.track.at(s, side * (_kerb(plan, side) + 0.5))
        if plan.free(x, z, 0.3):
            kind = int(rng.integers(0, SIGNS))
            size = rng.uniform(0.6, 0.8) if kind < 5 else rng.uniform(0.9, 1.3)
            plan.put(sign(plan.names, kind, size, rng.uniform(1.9, 2.4)), x, z,
                     heading + _ahead(side) + rng.uniform(-0.15, 0.15))


def _oddments(plan, side):
    """Bins, benches, bicycles and switch boxes at the back of the sidewalk."""
    for s in _along(plan, 17.0):
        x, z, heading = plan.main.track.at(s, side * (_kerb(plan, side) + plan.style.sidewalk - 0.35))
        if not plan.free(x, z, 0.8):
            continue
        what = plan.rng.integers(0, 4)
        faces = Faces(plan.names)
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
        plan.put(faces.matrix(), x, z, heading + plan.rng.uniform(-0.1, 0.1))


def _persons(plan, side):
    """People on the sidewalk: a third of them stand, the others walk either way."""
    rng, track = plan.rng, plan.main.track
    for _ in range(int((track.s[-1] - track.s[0]) * plan.style.persons)):
        s = rng.uniform(track.s[0], track.s[-1])
        d = side * (_kerb(plan, side) + rng.uniform(0.6, plan.style.sidewalk - 0.3))
        x, z, _ = track.at(s, d)
        if plan.free(x, z, 0.5):
            height = rng.uniform(1.6, 1.9)
            person = cut_out(plan.names, f"person{rng.integers(0, PERSONS)}", "person", height / 2, height)
            pace = float(rng.choice([0.0, 0.12, -0.12]))
            plan.movers.append(Mover(place(person, 0.0, 0.0, 0.0, -KERB), track, s, pace, d, rng.uniform(-0.5, 0.5)))


def _parked(plan, side):
    """Cars in the parking lane, slot by slot."""
    rng, road = plan.rng, plan.main
    s = road.track.s[0] + rng.uniform(0, 6)
    while s < road.track.s[-1] - 6:
        x, z, heading = road.track.at(s, side * (road.half + road.lane(side) / 2))
        kind = _any(rng, _PARKED)
        if rng.random() < plan.style.parked and plan.off_road(x, z)[0] > 0.3:
            plan.put(vehicle(plan.names, rng, kind), x, z, heading + _ahead(side) + rng.normal(0, 0.02), 0.0)
        s += _SLOTS.get(kind, 5.8) + rng.exponential(0.5)


def _traffic_lights(plan, side):
    """At sharp turns and the crossing."""
    crossing = plan.style.crossing
    for corner in [*plan.main.track.corners, *([] if crossing is None else [crossing])]:
        x, z, heading = plan.main.track.at(corner - 7.0, side * (_kerb(plan, side) + 0.4))
        if plan.free(x, z, 0.2):
            plan.put(traffic_light(plan.names), x, z, heading)


def _traffic(plan, side):
    """Oncoming cars and a cyclist on the left, on the right perhaps cars that drive ahead."""
    rng, style, track = plan.rng, plan.style, plan.main.track
    if side > 0:
        for k, distance in enumerate(style.leaders):
            _drive(plan, track, distance, None, style.half / 2, 0.0, ("estate", "van")[k % 2])
        return
    for s in _along(plan, 1 / max(style.traffic, 1e-4)):
        _drive(plan, track, s + 40, -rng.uniform(0.7, 1.1), -style.half / 2, np.pi)
    if rng.random() < 0.7:
        plan.movers.append(Mover(cyclist(plan.names), track, rng.uniform(25, 60), -0.35, 0.5 - style.half, np.pi))


def _highway_side(plan, side):
    """A guard rail, and behind it boards and lamps."""
    rng, half, track = plan.rng, plan.main.half, plan.main.track
    fence(plan, track, side, track.s[0], track.s[-1], 4.0, half + 0.7, "rail", "guard rail", 0.8, y=0.0, margin=0.3)
    s = track.s[0] + rng.uniform(5, 20)
    while s < track.s[-1] - 10:
        x, z, heading = track.at(s, side * (half + 2.2))
        if rng.random() < 0.5:
            plan.put(sign(plan.names, 5, rng.uniform(1.6, 2.6), 2.2, 0.06), x, z, heading, 0.0)
        else:
            plan.put(lamp(plan.names, 9.0, 2.5), x, z, heading + (0 if side < 0 else np.pi), 0.0)
        s += rng.uniform(25, 55)


def _highway_traffic(plan):
    """Cars in all three lanes, most of them faster than the camera."""
    rng, track = plan.rng, plan.main.track
    for k in range(int((track.s[-1] - track.s[0]) / 28)):
        lane = (-4.6, 0.0, 4.6)[k % 3]
        s = 25.0 + 26.0 * k + rng.uniform(-6, 6)
        _drive(plan, track, s if lane else s + 35, rng.uniform(1.35, 1.75), lane, 0.0)


def _bridge(plan):
    half = plan.main.half
    x, z, heading = plan.main.track.at(plan.style.bridge)
    faces = Faces(plan.names)
    faces.box((-30, 30), (-7.0, -5.6), (-4, 4), "concrete", "bridge", 8.0, gain=0.85)
    for pillar in (-half - 2.5, half + 1.5):
        faces.box((pillar, pillar + 1.0), (-5.6, 0.06), (-3, 3), "concrete", "bridge", 8.0, gain=0.8)
    plan.put(faces.matrix(), x, z, heading, 0.0)
