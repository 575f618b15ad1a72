"""Rendering one view of a street: a gray image with a label map that is exact to the pixel.

Both come from the same 2x2 samples a pixel: the image is their mean, the label is that of most of them (of the nearest
surface where they are even). Coordinates are those of KITTI: x right, y down, z forward, metres.
"""

import numpy as np

from thesis_repro.world import raster
from thesis_repro.world.raster import CORNER, EDGE_S, EDGE_T, GAIN, LIT, SUPERSAMPLING, X, Y, Z


def render(faces, textures, pose, intrinsics, size, environment):
    """Render one view: image float32 (height, width) before exposure and noise, and label map uint8 of that shape.

    faces: (n, COLUMNS) float64; textures: `raster.Textures`; pose: 4x4 camera-to-world; intrinsics: 3x3 in pixels whose
    centres have whole coordinates; size: (height, width); environment: `raster.Environment`.
    """
    middle = (faces[:, CORNER:CORNER + 3] + 0.5 * (faces[:, EDGE_S:EDGE_S + 3] + faces[:, EDGE_T:EDGE_T + 3])
              - pose[:3, 3])
    faces = faces[np.argsort((middle * middle).sum(axis=1), kind="stable")]  # from near to far
    view = raster.View(
        rotation=np.ascontiguousarray(pose[:3, :3].T), position=np.ascontiguousarray(pose[:3, 3]),
        focal=np.array([intrinsics[0, 0], intrinsics[1, 1]]) * SUPERSAMPLING,
        # Sample 0 of pixel 0 lies a quarter pixel before its centre.
        centre=(np.array([intrinsics[0, 2], intrinsics[1, 2]]) + 0.5) * SUPERSAMPLING - 0.5,
        size=(size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING))
    return raster.draw(faces, _brightness(faces, environment), textures, view, environment)


def _brightness(faces, environment):
    """What each face's texture is multiplied by, (n,): ambient light, and the sun by the cosine of its angle."""
    normal = np.cross(faces[:, EDGE_S:EDGE_S + 3], faces[:, EDGE_T:EDGE_T + 3])
    length = np.sqrt(normal[:, X] ** 2 + normal[:, Y] ** 2 + normal[:, Z] ** 2)
    sun = environment.sun
    cosine = -(normal[:, X] * sun[X] + normal[:, Y] * sun[Y] + normal[:, Z] * sun[Z]) / np.maximum(length, 1e-12)
    direct = np.where(faces[:, LIT] > 0, np.maximum(cosine, 0.0), 0.6)
    return faces[:, GAIN] * (environment.ambient + environment.direct * direct)


def compile_for_all():
    """Compile once and keep it on disk where possible, so that the processes started afterwards need not."""
    textures = raster.Textures(
        data=np.zeros(1, np.uint8), gray=np.zeros((1, raster.LEVELS, raster.LEVELS), np.int64),
        alpha=np.full((1, raster.LEVELS, raster.LEVELS), -1), sides=np.zeros((1, 2), np.int64), clouds=0, leaves=0)
    environment = raster.Environment(np.ones(3), *[1.0] * 7, skyline=np.zeros(2), skyline_labels=np.zeros(2, np.uint8))
    render(np.zeros((0, raster.COLUMNS)), textures, np.eye(4), np.eye(3), (1, 1), environment)
