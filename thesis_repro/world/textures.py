"""The textures of the embedded world, painted once for a seed and packed for the rasteriser."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.world import sprites, surfaces
from thesis_repro.world.raster import ALPHA_LEVELS, LEVELS, OPAQUE, Textures
from thesis_repro.world.surfaces import noise, speckle


class Bank(NamedTuple):
    """The textures of a world: names to indices, and the arrays for `render.render`."""

    names: dict
    packed: Textures


class _Packer:
    """Textures, each reduced along u and v separately.

    That keeps a road that is seen at a flat angle sharp across its markings without aliasing along them.
    """

    def __init__(self):
        self.names = {}
        self._chunks, self._length = [], 0
        self._gray, self._alpha, self._sides = [], [], []

    def add(self, name, gray, alpha=None):
        """Add a texture: uint8 (rows, columns). Raises ValueError where a side is no power of two."""
        height, width = gray.shape
        if height & (height - 1) or width & (width - 1):
            raise ValueError(f"texture {name}: sides {gray.shape} are not powers of two")
        self.names[name] = len(self.names)
        self._sides.append((height.bit_length() - 1, width.bit_length() - 1))
        self._gray.append(self._pack(gray, coverage=False))
        self._alpha.append(np.full((LEVELS, LEVELS), -1, np.int64) if alpha is None
                           else self._pack(alpha, coverage=True))

    def _pack(self, texture, coverage):
        """Store all levels of a texture; returns where each starts, (LEVELS, LEVELS), -1 where there is none."""
        offsets = np.full((LEVELS, LEVELS), -1, np.int64)
        covered = np.mean(texture >= OPAQUE)
        tall = texture.astype(np.float32)
        levels = ALPHA_LEVELS if coverage else LEVELS
        for row_level in range(min(levels, texture.shape[0].bit_length())):
            level = tall
            for column_level in range(min(levels, texture.shape[1].bit_length())):
                stored = level
                if coverage and 0 < covered < 1:
                    # Averaged leaves would fall below the opacity threshold and far trees would thin out.
                    threshold = np.quantile(level, 1 - covered)
                    stored = level * (OPAQUE / max(threshold, 1.0))
                offsets[row_level, column_level] = self._length
                self._chunks.append(np.clip(np.rint(stored), 0, 255).astype(np.uint8).ravel())
                self._length += level.size
                if level.shape[1] > 1:
                    level = (level[:, 0::2] + level[:, 1::2]) * np.float32(0.5)
            if tall.shape[0] > 1:
                tall = (tall[0::2] + tall[1::2]) * np.float32(0.5)
        return offsets

    def bank(self):
        return Bank(self.names, Textures(np.concatenate(self._chunks), np.array(self._gray), np.array(self._alpha),
                                         np.array(self._sides, np.int64), self.names["clouds"], self.names["leaves"]))


@lru_cache(maxsize=1)
def build(seed):
    """All textures of the world with this seed, a `Bank`."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 7001]))
    packer = _Packer()

    def whole(image):
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def add(name, gray, alpha=None):
        packer.add(name, whole(gray), None if alpha is None else whole(alpha))

    road = surfaces.road(rng)
    add("lane", road[::2, ::2].copy())
    marked = surfaces.road(rng)
    surfaces.marking(rng, marked, 0.492, 0.508, 3)
    surfaces.marking(rng, marked, 0.028, 0.044, 0)
    surfaces.marking(rng, marked, 0.956, 0.972, 0)
    add("road", marked)
    highway = surfaces.asphalt(rng, (1024, 1024), 112, 2)
    for x in (0.05, 0.95):
        surfaces.marking(rng, highway, x - 0.008, x + 0.008, 0, 220)
    for x in (0.35, 0.65):
        surfaces.marking(rng, highway, x - 0.005, x + 0.005, 2, 215)
    add("highway", highway)
    add("asphalt", surfaces.asphalt(rng, (512, 512), 96, 6))
    parking = surfaces.tiles(rng, (512, 128), 64, 8, 1, spread=10) + 112 + 4 * noise(rng, (512, 128), 32, 4)
    parking[:6] = 190
    parking[256:262] = 190
    add("parking", parking)
    add("sidewalk", 148 + surfaces.tiles(rng, (512, 256), 16, 8, 2) + 6 * noise(rng, (512, 256), 64, 5)
        + 3 * speckle(rng, (512, 256)))
    kerb = 168 + 8 * noise(rng, (512, 32), 16, 4)
    kerb[::64], kerb[1::64] = 90, 90
    add("kerb", kerb)
    grass = 76 + 10 * noise(rng, (512, 512), 128, 3) + 9 * noise(rng, (512, 512), 8, 3) + 12 * speckle(
        rng, (512, 512), 0.9)
    add("grass", grass)
    add("gravel", 132 + 9 * noise(rng, (512, 512), 64, 4) + 13 * speckle(rng, (512, 512), 1.2))
    slabs = surfaces.tiles(rng, (512, 512), 4, 4, 3, spread=4, offset=False)
    add("concrete", 150 + slabs + 9 * noise(rng, (512, 512), 64, 5))
    add("roof", 74 + surfaces.tiles(rng, (256, 256), 20, 16, 3, spread=10) + 7 * noise(rng, (256, 256), 64, 4))
    add("stone", 126 + surfaces.tiles(rng, (256, 512), 10, 10, 4, spread=17) + 8 * noise(rng, (256, 512), 32, 5))
    add("wood", 92 + 18 * noise(rng, (8, 256), 4, 2).repeat(16, axis=0) * 0.4
        + 9 * noise(rng, (128, 256), 16, 4) - 40 * (np.arange(256)[None] % 16 < 2))
    for kind in range(surfaces.FACADES):
        add(f"facade{kind}", surfaces.facade(rng, kind))
        add(f"shop{kind}", surfaces.shop(rng, kind))
    leaves = sprites.leaves(rng, (512, 512))
    add("leaves", leaves)
    add("hedge", cv2.resize(sprites.leaves(rng, (512, 512), 30, 100, 5), (256, 256), interpolation=cv2.INTER_AREA))
    for kind in range(sprites.TREES):
        tone = (1, 0.85, 1.1, 0.95, 0.62, 0.7)[kind]
        add(f"tree{kind}", *sprites.tree(rng, kind, np.roll(leaves, 83 * kind, axis=1) * tone))
    bush_shape = (128, 256)
    y, x = np.mgrid[0:128, 0:256].astype(np.float32)
    for kind in range(2):
        body = 1 - ((x - 128) / 118) ** 2 - ((y - 132) / 112) ** 2 + 0.22 * noise(rng, bush_shape, 32, 5, 0.8)
        alpha = np.where((body > 0.12) & (y > 4) & (x > 3) & (x < 252), 255.0, 0.0).astype(np.float32)
        add(f"bush{kind}", leaves[:128, 256 * kind:256 * kind + 256] * (1.1 - 0.35 * y / 128), alpha)
    for kind in range(sprites.PERSONS):
        add(f"person{kind}", *sprites.person(rng, kind))
    add("bicycle", *sprites.bicycle(rng))
    add("rider", *sprites.rider(rng))
    for name in ("picket", "wire", "rail"):
        add(name, *sprites.bars(rng, name))
    for kind in range(sprites.SIGNS):
        front, alpha = sprites.sign(rng, kind)
        add(f"sign{kind}", front, alpha)
        add(f"back{kind}", 118 + 5 * noise(rng, front.shape, 32, 4), alpha[:, ::-1])
    add("light", sprites.traffic_light(rng))
    add("metal", 92 + 7 * noise(rng, (128, 32), 16, 4) + np.linspace(35, -35, 32, dtype=np.float32)[None])
    add("bin", 62 + 9 * noise(rng, (64, 64), 16, 4) - 25 * (np.arange(64)[None] % 16 < 2))
    add("glass", sprites.glass(rng))
    for paint_index, paint in enumerate((205, 150, 90, 52, 38, 178)):
        add(f"paint{paint_index}", 1.08 * paint + 1.5 * noise(rng, (128, 128), 64, 3) + np.linspace(
            12, -12, 128, dtype=np.float32)[:, None])
        add(f"front{paint_index}", sprites.end(rng, paint, True))
        add(f"rear{paint_index}", sprites.end(rng, paint, False))
        for kind in sprites.PROFILES:
            if kind in ("truck", "bus") and paint_index not in (0, 2):
                continue
            add(f"{kind}{paint_index}", *sprites.side(rng, kind, paint))
    clouds = noise(rng, (512, 1024), 128, 6, 0.55)
    add("clouds", 128 + 60 * np.clip(clouds - 0.2, 0, 2))
    return packer.bank()
