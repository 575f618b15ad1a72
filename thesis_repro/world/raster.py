"""Rendering one view of a street: a gray image with a label map that is exact to the pixel.

Both come from the same 2x2 samples a pixel: the image is their mean, the label is that of most of them (of the nearest
surface where they are even). Coordinates are those of KITTI: x right, y down, z forward, metres.

A face is a parallelogram or a triangle, the points corner + s edge_s + t edge_t. A sample's ray consists of the points
p / w with p = (x, y, 1) in camera coordinates and the inverse depth w = 1 / z. Where they meet, Cramer's rule gives

    w   = p . (edge_s x edge_t) / volume         volume = corner . (edge_s x edge_t)
    w s = p . (edge_t x corner) / volume
    w t = p . (corner x edge_s) / volume

all three linear in the sample's coordinates. So no face has to be clipped and every sample is exact: it lies inside
where s and t do, the largest w is the nearest surface, and (w s) / w and (w t) / w are its place on the texture.

All compiled code lies in this module, as do the numbers of its columns, because numba looks at no other file when it
decides whether what it kept on disk still holds. No fast-math and no threads: the same input gives the same bytes.
Arrays are taken out of their named tuples, and rows out of matrices, outside the inner loops: each time counts a
reference, which costs more than the work.
"""

import math
from typing import NamedTuple

import numpy as np

from thesis_repro.cityscapes import ID
from thesis_repro.compiled import fast, inner

# Columns of the face matrix, one row a face.
CORNER, EDGE_S, EDGE_T = 0, 3, 6  # three each; CORNER + Y is the corner's y
X, Y, Z = 0, 1, 2
U, U_S, U_T = 9, 10, 11  # u = f[U] + f[U_S] s + f[U_T] t, in repeats of the texture, to the right
V, V_S, V_T = 12, 13, 14  # v likewise, downwards
TEXTURE, LABEL, GAIN = 15, 16, 17
TRIANGLE = 18  # 1: s + t <= 1; 0: parallelogram
GROUND = 19  # which ground level the face is part of; only the ground receives shadows, only the rest (0) casts them
LIT = 20  # 1: shaded by its outward normal (edge_s x edge_t), 0: evenly, as leaves and grass
COLUMNS = 21

ROAD, SIDEWALK = 1, 2  # ground levels
GROUND_LEVELS = np.array([0.0, 0.0, -0.12])  # their y; the first entry is a filler

# Columns of the coefficients: w s = c[S] + c[S_X] x + c[S_Y] y at sample (x, y), w t and w likewise.
S, S_X, S_Y, T, T_X, T_Y, W, W_X, W_Y = range(9)

NEAR = 0.25  # metres
FAR = 220.0
SHADOW_FAR = 70.0
LEVELS = 12  # sides up to 2048
ALPHA_LEVELS = 5  # thinner than that, cut-outs flicker rather than vanish
SUPERSAMPLING = 2  # samples a pixel, each way
OPAQUE = 128
COUNTED = -2  # a sample that is dealt with; -1 is the background
SHARPNESS = 0.75  # part of a pixel that a texture is averaged over; the rest is contrast against a little aliasing
SKY, TERRAIN, VEGETATION = ID["sky"], ID["terrain"], ID["vegetation"]


class Textures(NamedTuple):
    """All textures in one array of bytes; those of level (j, i) are reduced j times along v and i times along u."""

    data: np.ndarray  # uint8: gray values and alphas
    gray: np.ndarray  # (n, LEVELS, LEVELS) where each level of a texture starts
    alpha: np.ndarray  # the same of its alpha, -1 where it has none
    sides: np.ndarray  # (n, 2) log2 of rows and columns
    clouds: int  # the two that the background shows
    leaves: int


class View(NamedTuple):
    """A camera over the samples; sample (0, 0) is the origin."""

    rotation: np.ndarray  # (3, 3) street to camera
    position: np.ndarray  # (3,) metres
    focal: np.ndarray  # (2,) samples, along x and y
    centre: np.ndarray  # (2,) samples
    size: tuple  # rows and columns of samples


class Environment(NamedTuple):
    """The light of a street and what is seen beyond its faces; brightnesses are gray values."""

    sun: np.ndarray  # (3,) direction of travel of the light, unit length, y > 0
    ambient: float  # how much of the albedo is seen without the sun
    direct: float  # what the sun adds where it falls straight on a face
    shadow: float  # how much of the ground's brightness is left in shadow
    zenith: float
    horizon: float
    clouds: float  # weight of their texture
    haze: float  # extinction, 1/m
    skyline: np.ndarray  # (n,) elevation (tangent) over the azimuth, from -pi to pi


# Textures


@inner
def _between(place, log_size):
    """Which two of the texels along one axis a place (in repeats) lies between, and how near to the second one."""
    size = 1 << log_size
    x = place * size - 0.5
    x0 = int(x)
    if x < x0:
        x0 -= 1
    return x0 & (size - 1), (x0 + 1) & (size - 1), x - x0


@inner
def _mix(data, offset, log_width, x, y):
    """A texture's level between its texels: offset: where it starts; x, y: of `_between`."""
    (x0, x1, fx), (y0, y1, fy) = x, y
    row0, row1 = offset + (y0 << log_width), offset + (y1 << log_width)
    top = data[row0 + x0] * (1 - fx) + data[row0 + x1] * fx
    bottom = data[row1 + x0] * (1 - fx) + data[row1 + x1] * fx
    return top * (1 - fy) + bottom * fy


@inner
def _sample(data, level, u, v):
    """A texture at (u, v), bilinear and periodic; level: (offset, log2 of rows, log2 of columns)."""
    offset, log_height, log_width = level
    return _mix(data, offset, log_width, _between(u, log_width), _between(v, log_height))


@inner
def _whole(textures, index):
    """The level of a texture that is not reduced."""
    return textures.gray[index, 0, 0], textures.sides[index, 0], textures.sides[index, 1]


@inner
def _level(step, levels):
    """Which reduced level suits a step of so many texels, and the part of the next one: log2, linear between powers."""
    level = 0
    while step >= 2.0 and level < levels:
        step *= 0.5
        level += 1
    return level, (step - 1.0 if level < levels and step > 1.0 else 0.0)


@inner
def _filtered(data, gray, texture, log_height, log_width, u, v, u_step, v_step):
    """Texture value for a sample that covers u_step by v_step repeats; blends neighbouring levels of both axes."""
    i, u_part = _level(u_step * (1 << log_width), log_width)
    j, v_part = _level(v_step * (1 << log_height), log_height)
    rows, columns = log_height - j, log_width - i
    x, y = _between(u, columns), _between(v, rows)
    value = _mix(data, gray[texture, j, i], columns, x, y)
    if u_part > 0.0:
        half_x = _between(u, columns - 1)
        value += u_part * (_mix(data, gray[texture, j, i + 1], columns - 1, half_x, y) - value)
    if v_part > 0.0:
        half_y = _between(v, rows - 1)
        other = _mix(data, gray[texture, j + 1, i], columns, x, half_y)
        if u_part > 0.0:
            other += u_part * (_mix(data, gray[texture, j + 1, i + 1], columns - 1, half_x, half_y) - other)
        value += v_part * (other - value)
    return value


@inner
def _steps(coefficients, faces, index, s, t, w):
    """How far u and v move from one sample to the next, the larger of both image directions.

    By the quotient rule ds/dx = (d(w s)/dx - s dw/dx) / w.
    """
    c, f, n, z = coefficients, faces, index, 1.0 / w
    s_x, s_y = (c[n, S_X] - s * c[n, W_X]) * z, (c[n, S_Y] - s * c[n, W_Y]) * z
    t_x, t_y = (c[n, T_X] - t * c[n, W_X]) * z, (c[n, T_Y] - t * c[n, W_Y]) * z
    u_step = max(abs(f[n, U_S] * s_x + f[n, U_T] * t_x), abs(f[n, U_S] * s_y + f[n, U_T] * t_y))
    v_step = max(abs(f[n, V_S] * s_x + f[n, V_T] * t_x), abs(f[n, V_S] * s_y + f[n, V_T] * t_y))
    return u_step, v_step


@inner
def _alpha_level(alpha, sides, coefficients, faces, index, row, x):
    """The level of a face's alpha that suits one row of it: (offset, log2 of rows, log2 of columns)."""
    c, n, texture = coefficients, index, int(faces[index, TEXTURE])
    log_height, log_width = sides[texture, 0], sides[texture, 1]
    w = c[n, W] + c[n, W_Y] * row + c[n, W_X] * x
    u_step, v_step = _steps(c, faces, n, (c[n, S] + c[n, S_Y] * row + c[n, S_X] * x) / w,
                            (c[n, T] + c[n, T_Y] * row + c[n, T_X] * x) / w, w)
    i = j = 0
    u_step *= 1 << log_width
    v_step *= 1 << log_height
    while u_step > 1.5 and i < min(ALPHA_LEVELS - 1, log_width):
        u_step *= 0.5
        i += 1
    while v_step > 1.5 and j < min(ALPHA_LEVELS - 1, log_height):
        v_step *= 0.5
        j += 1
    return alpha[texture, j, i], log_height - j, log_width - i


@inner
def _opaque(data, level, face, c, row, x, w):
    """Whether a cut-out is there at a sample, where its inverse depth is w."""
    ws, wt, z = c[S] + c[S_Y] * row + c[S_X] * x, c[T] + c[T_Y] * row + c[T_X] * x, 1.0 / w
    u = face[U] + (face[U_S] * ws + face[U_T] * wt) * z
    v = face[V] + (face[V_S] * ws + face[V_T] * wt) * z
    return _sample(data, level, u, v) >= OPAQUE


# Which samples a face covers


@inner
def _turn(rotation, x, y, z):
    """A vector in the street in camera coordinates."""
    return (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
            rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
            rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z)


@inner
def _set_up(corner, edge_s, edge_t, view, c):
    """Fill in a face's coefficients; returns the first and last row that it may cover (0, -1: none).

    corner, edge_s and edge_t are in camera coordinates; `c` receives the nine coefficients.
    """
    focal, centre = view.focal, view.centre
    height, width = view.size
    far_away = True
    behind = 0
    x_min = y_min = 1e30
    x_max = y_max = -1e30
    for k in range(4):
        s, t = float(k & 1), float(k >> 1)
        x = corner[0] + s * edge_s[0] + t * edge_t[0]
        y = corner[1] + s * edge_s[1] + t * edge_t[1]
        z = corner[2] + s * edge_s[2] + t * edge_t[2]
        if z < FAR:
            far_away = False
        if z < NEAR:
            behind += 1
        else:
            px, py = focal[0] * x / z + centre[0], focal[1] * y / z + centre[1]
            x_min, x_max = min(x_min, px), max(x_max, px)
            y_min, y_max = min(y_min, py), max(y_max, py)
    if far_away or behind == 4:
        return 0, -1
    if behind:
        y_min, y_max = 0.0, height - 1.0
    elif x_max < 0 or x_min > width - 1 or y_max < 0 or y_min > height - 1:
        return 0, -1
    sx, sy, sz = edge_s[0], edge_s[1], edge_s[2]
    tx, ty, tz = edge_t[0], edge_t[1], edge_t[2]
    ox, oy, oz = corner[0], corner[1], corner[2]
    nx, ny, nz = sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx  # edge_s x edge_t
    volume = ox * nx + oy * ny + oz * nz
    if abs(volume) < 1e-9:  # seen edge-on
        return 0, -1
    ax, ay, az = ty * oz - tz * oy, tz * ox - tx * oz, tx * oy - ty * ox  # edge_t x corner
    bx, by, bz = oy * sz - oz * sy, oz * sx - ox * sz, ox * sy - oy * sx  # corner x edge_s
    for k in range(3):
        vx, vy, vz = (ax, ay, az) if k == 0 else ((bx, by, bz) if k == 1 else (nx, ny, nz))
        step_x, step_y = vx / focal[0] / volume, vy / focal[1] / volume
        c[3 * k] = vz / volume - centre[0] * step_x - centre[1] * step_y
        c[3 * k + 1] = step_x
        c[3 * k + 2] = step_y
    return max(0, math.ceil(y_min)), min(height - 1, math.floor(y_max))


@inner
def _narrow(value, slope, low, high):
    """Keep the part of [low, high] where value + slope x >= 0."""
    if slope > 0:
        low = max(low, -value / slope)
    elif slope < 0:
        high = min(high, -value / slope)
    elif value < 0:
        high = low - 1.0
    return low, high


@inner
def _span(c, triangle, row, width):
    """First and last sample of a row inside the face: w > 0, z > NEAR, s >= 0, t >= 0, and s, t or s + t <= 1."""
    ws, wt, w = c[S] + c[S_Y] * row, c[T] + c[T_Y] * row, c[W] + c[W_Y] * row
    low, high = 0.0, width - 1.0
    slack = 1e-7  # neighbours overlap by this part of their edges, so that no crack opens between them
    low, high = _narrow(w - 1e-6, c[W_X], low, high)
    low, high = _narrow(1.0 / NEAR - w, -c[W_X], low, high)
    low, high = _narrow(ws + slack * w, c[S_X] + slack * c[W_X], low, high)
    low, high = _narrow(wt + slack * w, c[T_X] + slack * c[W_X], low, high)
    if triangle:
        low, high = _narrow((1 + slack) * w - ws - wt, (1 + slack) * c[W_X] - c[S_X] - c[T_X], low, high)
    else:
        low, high = _narrow((1 + slack) * w - ws, (1 + slack) * c[W_X] - c[S_X], low, high)
        low, high = _narrow((1 + slack) * w - wt, (1 + slack) * c[W_X] - c[T_X], low, high)
    if high < low:
        return 0, -1
    return math.ceil(low), math.floor(high)


@fast
def _surfaces(faces, textures, view, coefficients, depth, nearest):
    """The nearest face at each sample: fills `depth` (w), `nearest` (row of `faces`) and the faces' coefficients."""
    data, alpha, sides = textures.data, textures.alpha, textures.sides
    rotation, position, width = view.rotation, view.position, view.size[1]
    for index in range(faces.shape[0]):
        face, c = faces[index], coefficients[index]
        corner = _turn(rotation, face[CORNER + X] - position[X], face[CORNER + Y] - position[Y],
                       face[CORNER + Z] - position[Z])
        edge_s = _turn(rotation, face[EDGE_S + X], face[EDGE_S + Y], face[EDGE_S + Z])
        edge_t = _turn(rotation, face[EDGE_T + X], face[EDGE_T + Y], face[EDGE_T + Z])
        first_row, last_row = _set_up(corner, edge_s, edge_t, view, c)
        if last_row < first_row:
            continue
        cut_out = alpha[int(face[TEXTURE]), 0, 0] >= 0
        triangle = face[TRIANGLE] > 0
        for row in range(first_row, last_row + 1):
            start, stop = _span(c, triangle, row, width)
            if stop < start:
                continue
            w_row, w_x = c[W] + c[W_Y] * row, c[W_X]
            if cut_out:
                level = _alpha_level(alpha, sides, coefficients, faces, index, row, (start + stop) // 2)
                for x in range(start, stop + 1):
                    w = w_row + w_x * x
                    if w > depth[row, x] and _opaque(data, level, face, c, row, x, w):
                        depth[row, x] = w
                        nearest[row, x] = index
            else:
                depths, hits = depth[row, start:stop + 1], nearest[row, start:stop + 1]
                for k in range(len(depths)):  # from 0, so that many are compared at once
                    w = w_row + w_x * (start + k)
                    if w > depths[k]:
                        depths[k] = w
                        hits[k] = index


@fast
def _shadows(faces, textures, view, sun, nearest, shadow):
    """Mark the ground samples that a face shades: its shadow on each ground level, drawn as a face.

    A point falls along the sun by (level - y) / sun_y to the level, so an edge e becomes e - sun e_y / sun_y, and the
    shadow of a face is again corner, edge_s and edge_t, with the same (s, t) and so the same alpha.
    """
    data, alpha, sides = textures.data, textures.alpha, textures.sides
    rotation, position, width = view.rotation, view.position, view.size[1]
    flat_corner, flat_s, flat_t = np.empty(3), np.empty(3), np.empty(3)
    coefficients = np.empty((faces.shape[0], 9))
    for index in range(faces.shape[0]):
        face, c = faces[index], coefficients[index]
        if face[GROUND] > 0:
            continue
        if math.hypot(face[CORNER + X] - position[X], face[CORNER + Z] - position[Z]) > SHADOW_FAR:
            continue
        cut_out = alpha[int(face[TEXTURE]), 0, 0] >= 0
        triangle = face[TRIANGLE] > 0
        for ground in range(1, len(GROUND_LEVELS)):
            fall = (GROUND_LEVELS[ground] - face[CORNER + Y]) / sun[Y]
            for k in range(3):
                flat_corner[k] = face[CORNER + k] + sun[k] * fall - position[k]
                flat_s[k] = face[EDGE_S + k] - sun[k] * face[EDGE_S + Y] / sun[Y]
                flat_t[k] = face[EDGE_T + k] - sun[k] * face[EDGE_T + Y] / sun[Y]
            first_row, last_row = _set_up(
                _turn(rotation, flat_corner[X], flat_corner[Y], flat_corner[Z]),
                _turn(rotation, flat_s[X], flat_s[Y], flat_s[Z]), _turn(rotation, flat_t[X], flat_t[Y], flat_t[Z]),
                view, c)
            for row in range(first_row, last_row + 1):
                start, stop = _span(c, triangle, row, width)
                if stop < start:
                    continue
                if cut_out:
                    level = _alpha_level(alpha, sides, coefficients, faces, index, row, (start + stop) // 2)
                for x in range(start, stop + 1):
                    if shadow[row, x] or nearest[row, x] < 0 or faces[nearest[row, x], GROUND] != ground:
                        continue
                    if cut_out:
                        w = c[W] + c[W_Y] * row + c[W_X] * x
                        if not _opaque(data, level, face, c, row, x, w):
                            continue
                    shadow[row, x] = True


# From samples to pixels


@inner
def _surface_value(faces, coefficients, index, row, column, w, spread, data, gray, sides):
    """Texture of a face at a place (in samples), averaged over a square of `spread` samples."""
    c, f, n, texture = coefficients, faces, index, int(faces[index, TEXTURE])
    s = (c[n, S] + c[n, S_Y] * row + c[n, S_X] * column) / w
    t = (c[n, T] + c[n, T_Y] * row + c[n, T_X] * column) / w
    u_step, v_step = _steps(c, f, n, s, t, w)
    u = f[n, U] + f[n, U_S] * s + f[n, U_T] * t
    v = f[n, V] + f[n, V_S] * s + f[n, V_T] * t
    return _filtered(data, gray, texture, sides[texture, 0], sides[texture, 1], u, v, u_step * spread, v_step * spread)


@inner
def _background(x, y, rotation, environment, skyline, data, clouds, leaves):
    """Value and label where no face is, in direction (x, y, 1): sky and clouds, the skyline, the ground far away.

    clouds, leaves: the levels of these textures.
    """
    right = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0]
    down = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1]
    ahead = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2]
    azimuth = math.atan2(right, ahead)
    elevation = -down / math.hypot(right, ahead)
    place = (azimuth + math.pi) * len(skyline) / (2 * math.pi)
    first = int(place) % len(skyline)
    part = place - math.floor(place)
    sky = environment.horizon
    if elevation > skyline[first] * (1 - part) + skyline[(first + 1) % len(skyline)] * part:
        cloud = _sample(data, clouds, azimuth / math.pi, -elevation) - 128.0
        blue = math.sqrt(min(1.0, elevation / 0.6))
        return sky + (environment.zenith - sky) * blue + cloud * environment.clouds, SKY
    if elevation > -0.01:
        return 0.35 * _sample(data, leaves, azimuth * 3.0, -elevation * 3.0) + 0.42 * sky, VEGETATION
    return 0.75 * sky, TERRAIN


@inner
def _most(labels, counts, depths, surfaces):
    """The label of most samples; where two have as many, that of the nearer surface."""
    best, best_count, best_depth = labels[0], 0.0, -1.0
    for k in range(surfaces):
        count, closest = 0.0, 0.0
        for m in range(surfaces):
            if labels[m] == labels[k]:
                count += counts[m]
                closest = max(closest, depths[m])
        if count > best_count or (count == best_count and closest > best_depth):
            best, best_count, best_depth = labels[k], count, closest
    return best


def render(faces, textures, pose, intrinsics, size, environment):
    """Render one view: image float32 (height, width) before exposure and noise, and label map uint8 of that shape.

    faces: (n, COLUMNS) float64; textures: `Textures`; pose: 4x4 camera-to-world; intrinsics: 3x3 in pixels whose
    centres have whole coordinates; size: (height, width); environment: `Environment`.
    """
    middle = (faces[:, CORNER:CORNER + 3] + 0.5 * (faces[:, EDGE_S:EDGE_S + 3] + faces[:, EDGE_T:EDGE_T + 3])
              - pose[:3, 3])
    # From near to far, so that most of what is hidden costs one comparison.
    faces = faces[np.argsort((middle * middle).sum(axis=1), kind="stable")]
    view = View(
        rotation=np.ascontiguousarray(pose[:3, :3].T), position=np.ascontiguousarray(pose[:3, 3]),
        focal=np.array([intrinsics[0, 0], intrinsics[1, 1]]) * SUPERSAMPLING,
        # Sample 0 of pixel 0 lies a quarter pixel before its centre.
        centre=(np.array([intrinsics[0, 2], intrinsics[1, 2]]) + 0.5) * SUPERSAMPLING - 0.5,
        size=(size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING))
    depth = np.full(view.size, 1.0 / FAR, np.float32)
    nearest = np.full(view.size, -1, np.int32)
    shadow = np.zeros(view.size, np.bool_)
    coefficients = np.empty((faces.shape[0], 9))
    _surfaces(faces, textures, view, coefficients, depth, nearest)
    _shadows(faces, textures, view, environment.sun, nearest, shadow)
    return _pixels(faces, _brightness(faces, environment), textures, view, environment, coefficients, nearest, shadow)


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
    textures = Textures(
        data=np.zeros(1, np.uint8), gray=np.zeros((1, LEVELS, LEVELS), np.int64),
        alpha=np.full((1, LEVELS, LEVELS), -1), sides=np.zeros((1, 2), np.int64), clouds=0, leaves=0)
    environment = Environment(np.ones(3), *[1.0] * 7, skyline=np.zeros(2))
    render(np.zeros((0, COLUMNS)), textures, np.eye(4), np.eye(3), (1, 1), environment)


@fast
def _pixels(faces, brightness, textures, view, environment, coefficients, nearest, shadow):
    """Image and label map, from what each sample sees."""
    height, width = view.size[0] // SUPERSAMPLING, view.size[1] // SUPERSAMPLING
    image = np.empty((height, width), np.float32)
    label_map = np.empty((height, width), np.uint8)
    hits, counts, labels, depths = np.empty(4, np.int32), np.empty(4), np.empty(4, np.uint8), np.empty(4)
    data, gray, sides = textures.data, textures.gray, textures.sides
    clouds, leaves = _whole(textures, textures.clouds), _whole(textures, textures.leaves)
    rotation, focal, centre = view.rotation, view.focal, view.centre
    skyline = environment.skyline
    dark, haze, horizon = 1.0 - environment.shadow, environment.haze, environment.horizon
    for i in range(height):
        for j in range(width):
            # The texture of each face in the pixel is read once, in the middle of its samples.
            surfaces, total = 0, 0.0
            for k in range(4):
                hits[k] = nearest[2 * i + (k >> 1), 2 * j + (k & 1)]
            for k in range(4):
                index = hits[k]
                if index == COUNTED:  # most pixels show one surface
                    continue
                count, row, column, shaded = 0, 0, 0, 0
                for m in range(k, 4):
                    if hits[m] == index:
                        count += 1
                        row += 2 * i + (m >> 1)
                        column += 2 * j + (m & 1)
                        shaded += shadow[2 * i + (m >> 1), 2 * j + (m & 1)]
                        hits[m] = COUNTED
                y, x = row / count, column / count
                if index >= 0:
                    w = coefficients[index, W] + coefficients[index, W_Y] * y + coefficients[index, W_X] * x
                    spread = SHARPNESS * math.sqrt(count)
                    value = _surface_value(faces, coefficients, index, y, x, w, spread, data, gray, sides)
                    value *= brightness[index] * (1.0 - dark * shaded / count)
                    clear = math.exp(-haze / w)
                    value = value * clear + horizon * (1 - clear)
                    label = int(faces[index, LABEL])
                else:
                    value, label = _background((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], rotation,
                                               environment, skyline, data, clouds, leaves)
                    w = 0.0
                total += count * value
                labels[surfaces], counts[surfaces], depths[surfaces] = label, count, w
                surfaces += 1
            image[i, j] = total * 0.25
            label_map[i, j] = _most(labels, counts, depths, surfaces)
    return image, label_map
