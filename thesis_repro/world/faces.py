"""Rows of the face matrix: parallelograms and triangles with a texture and a label, to build streets from."""

import numpy as np

from thesis_repro.cityscapes import ID
from thesis_repro.world.raster import COLUMNS, CORNER, EDGE_S, EDGE_T, X, Y, Z


class Faces:
    """Rows of the face matrix in the making; `names` maps textures to their indices.

    Faces are rectangles that are seen from outside, edge_s to the right and edge_t up, where nothing else is said.
    """

    def __init__(self, names):
        self.names, self._rows = names, []

    def add(self, corner, edge_s, edge_t, texture, label, repeats=(1.0, 1.0), uv=None, gain=1.0, triangle=0, ground=0,
            casts=1, lit=1):
        """Add one face; corner and edges in metres. The rest are the matrix' columns, as `raster` describes them.

        repeats: of the texture along edge_s and edge_t, upright; or uv: the six numbers of u and v.
        """
        uv = uv or (0.0, repeats[0], 0.0, 1.0, 0.0, -repeats[1])
        self._rows.append((*corner, *edge_s, *edge_t, *uv, self.names[texture], ID[label], gain, triangle, ground,
                           casts, lit))

    def box(self, x, y, z, texture, label, metres, gain=1.0, front=None):
        """Add an upright box without a bottom between (low, high) of each axis; y low is the top.

        metres: of one repeat of the texture; front: another texture for the side that looks at -z.
        """
        (x0, x1), (top, bottom), (z0, z1) = x, y, z
        width, height, length = x1 - x0, bottom - top, z1 - z0
        up = (0, -height, 0)
        across, along = (width / metres, height / metres), (length / metres, height / metres)
        self.add((x0, bottom, z0), (width, 0, 0), up, front or texture, label, (1, 1) if front else across, gain=gain)
        self.add((x1, bottom, z1), (-width, 0, 0), up, texture, label, across, gain=gain)
        self.add((x1, bottom, z0), (0, 0, length), up, texture, label, along, gain=gain)
        self.add((x0, bottom, z1), (0, 0, -length), up, texture, label, along, gain=gain)
        self.add((x0, top, z0), (width, 0, 0), (0, 0, length), texture, label, (width / metres, length / metres),
                 gain=gain)

    def matrix(self):
        """The faces added so far, (n, COLUMNS)."""
        return np.array(self._rows, np.float64).reshape(-1, COLUMNS)


def rows(corner, edge_s, edge_t, uv, texture, label, ground, triangle):
    """Many lit faces without shadows at once, (n, COLUMNS): three (n, 3), the six of uv and `triangle` (n,) or single.

    texture, label: their numbers.
    """
    matrix = np.empty((len(corner), COLUMNS))
    for k, column in enumerate([*corner.T, *edge_s.T, *edge_t.T, *uv, texture, label, 1.0, triangle, ground, 0, 1]):
        matrix[:, k] = column
    return matrix


def place(faces, x, z, yaw, y=0.0):
    """Local faces (n, COLUMNS) turned by yaw (radians, right positive) and moved to (x, y, z)."""
    placed = faces.copy()
    cosine, sine = np.cos(yaw), np.sin(yaw)
    for start in (CORNER, EDGE_S, EDGE_T):
        local_x, local_z = faces[:, start + X], faces[:, start + Z]
        placed[:, start + X] = cosine * local_x + sine * local_z
        placed[:, start + Z] = cosine * local_z - sine * local_x
    placed[:, CORNER + X] += x
    placed[:, CORNER + Y] += y
    placed[:, CORNER + Z] += z
    return placed
