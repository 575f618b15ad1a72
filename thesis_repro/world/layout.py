"""Laying out one street: its roads, its ground, what stands and moves on it, and the sky above."""

import numpy as np

from thesis_repro.cityscapes import ID
from thesis_repro.world import ground, roadside, zones
from thesis_repro.world.raster import Environment
from thesis_repro.world.street import LAYER, Plan, Road, Street
from thesis_repro.world.surfaces import noise
from thesis_repro.world.track import Track


def build(rng, bank, track, style):
    """Lay out a `Street` along a `Track`.

    rng: NumPy generator, on which alone the street depends besides these; bank: of `textures.build`; style: `Style`.
    """
    plan = Plan(rng, bank.names, style, _roads(rng, track, style))
    if style.crossing is not None:
        roadside.crossing_traffic(plan, plan.roads[-1].track)
    ground.lay(plan)
    zones.build_up(plan)
    roadside.furnish(plan)
    return Street(np.ascontiguousarray(np.concatenate(plan.parts)), plan.movers, bank.packed, environment(rng, style))


def _roads(rng, track, style):
    """The main road and those that leave it; a crossing is the last."""
    roads = [Road(track, style.half, style.parking)]

    def add(s, turn, half, start=0.0, stop=70.0):
        x, z, heading = track.at(s)
        roads.append(Road(Track([], start, stop, (x, z), heading + turn), half, lower=LAYER * len(roads)))

    for corner in track.corners:  # at a sharp turn the old direction goes on as a side road
        if track.closed or corner < track.s[-1] - 40:
            add(corner - 4.0, 0.0, style.half * 0.9)
    s = track.s[0] + 60
    while s < track.s[-1] - 20 and style.road != "highway":
        s += rng.uniform(35, 80)
        if np.interp(s, track.s, np.abs(track.curvature)) < 0.01:
            side = -np.sign(track.heading[-1] - track.heading[0]) if track.closed else rng.choice([-1, 1])
            add(s, np.pi / 2 * side, style.half * 0.85)
    if style.crossing is not None:
        add(style.crossing, -np.pi / 2, style.half, -75.0, 75.0)
    return roads


def environment(rng, style):
    """The light of a style, and a skyline of trees and a few houses: `raster.Environment`."""
    azimuth, elevation = style.sun if style.sunny else (style.sun[0], 1.35)
    sun = np.array([-np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])
    # Under clouds the light comes from above and shadows are faint pools under things.
    ambient, direct, shadow = (0.36, 0.86, 0.36) if style.sunny else (0.70, 0.30, 0.62)
    zenith, horizon, clouds = (float(value) for value in style.sky)
    columns = 2048
    skyline = np.maximum(0.0, 0.035 + 0.022 * noise(rng, (8, columns), 256, 5)[0])
    labels = np.full(columns, ID["vegetation"], np.uint8)
    for _ in range(int(rng.integers(3, 9))):  # distant houses
        left, width = int(rng.integers(0, columns - 60)), int(rng.integers(12, 50))
        skyline[left:left + width] = rng.uniform(0.04, 0.09)
        labels[left:left + width] = ID["building"]
    return Environment(sun, ambient, direct, shadow, zenith, horizon, clouds, style.haze, skyline.astype(np.float64),
                       labels)
