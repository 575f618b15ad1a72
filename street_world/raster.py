"""Rendering one view of a street: a gray image with a label map that is exact to the pixel.

Image and label map come from the same 2x2 samples a pixel. The image is their mean. The label is
the most frequent one; of two equally frequent ones, the label of the nearer surface. Coordinates as
in KITTI: x right, y down, z forward, in metres.

A face is a parallelogram or a triangle with the points corner + s edge_s + t edge_t. The ray of a
sample has the points p / w, with p = (x, y, 1) in camera coordinates and the inverse depth w = 1 /
z. Cramer's rule gives the intersection

    w   = p . (edge_s x edge_t) / volume         volume = corner . (edge_s x edge_t)
    w s = p . (edge_t x corner) / volume
    w t = p . (corner x edge_s) / volume

All three are linear in the sample's coordinates, so no face has to be clipped. The sample is inside
the face if s and t are between 0 and 1, the largest w is the nearest surface, and (w s) / w and (w
t) / w give the position on the texture.

The same input gives the same bytes, because no fast-math and no threads are used. Arrays are taken
out of named tuples, and rows out of matrices, outside the inner loops, because each access counts a
reference, which costs more than the arithmetic.
"""

import math
from typing import NamedTuple

import numpy as np

from opencv_exact.compiling import compiled, inlined
from thesis_repro.data.cityscapes import ID

# Columns of the face matrix; each row is a face.
CORNER, EDGE_S, EDGE_T = 0, 3, 6  # three each; CORNER + Y is the corner's y
X, Y, Z = 0, 1, 2
U, U_S, U_T = 9, 10, 11  # u = f[U] + f[U_S] s + f[U_T] t, in repeats of the texture, to the right
V, V_S, V_T = 12, 13, 14  # v likewise, downwards
TEXTURE, LABEL, GAIN = 15, 16, 17
TRIANGLE = 18  # 1: s + t <= 1; 0: parallelogram
GROUND = 19  # 1: part of the ground, which receives shadows; 0: a thing, which casts them
LIT = 20  # 1: shaded by its outward normal (edge_s x edge_t); 0: shaded evenly, such as leaves
FACE_COLUMNS = 21

# Columns of the coefficients: w s = c[S] + c[S_X] x + c[S_Y] y at sample (x, y); w t and w
# likewise.
S, S_X, S_Y, T, T_X, T_Y, W, W_X, W_Y = range(9)

NEAR = 0.25  # metres
SHADOW_FAR = 70.0  # metres; sky and forest are farther away, so they cast no shadow
LEVELS = 12  # for textures with sides up to 2048
ALPHA_LEVELS = 5  # at coarser levels, thin cut-outs would vanish
SUPERSAMPLING = 2  # samples a pixel, each way
OPAQUE = 128
UNLIT = 0.6  # share of the sun on evenly shaded faces
# share of a pixel that a texture is averaged over; less means more contrast and more aliasing
SHARPNESS = 0.75
SKY = ID["sky"]


class Textures(NamedTuple):
    """All textures in one array of bytes.

    Level (j, i) is halved j times along v and i times along u.
    """

    # uint8: gray values of each level, followed by its alphas if the texture is a cut-out
    data: np.ndarray
    start: np.ndarray  # (n, LEVELS, LEVELS) index of the first byte of each level
    sides: np.ndarray  # (n, 2) log2 of rows and columns
    cut_out: np.ndarray  # (n,) whether the texture has alphas


class View(NamedTuple):
    """A camera in sample coordinates; sample (0, 0) is the origin."""

    rotation: np.ndarray  # (3, 3) street to camera
    position: np.ndarray  # (3,) metres
    focal: np.ndarray  # (2,) samples, along x and y
    centre: np.ndarray  # (2,) samples
    size: tuple  # rows and columns of samples


class Environment(NamedTuple):
    """The light of a street; brightnesses are gray values."""

    sun: np.ndarray  # (3,) direction in which the light travels, unit length, y > 0
    ambient: float  # share of the albedo that is seen without the sun
    direct: float  # share that the sun adds on a face at right angles to the light
    shadow: float  # share of the ground's brightness that is left in shadow
    horizon: float  # gray value that distant surfaces fade to
    haze: float  # extinction, 1/m


# Textures


@inlined
def _between(place, log_size):
    """Return the two texels along one axis that a place lies between, and the second one's weight.

    place: in repeats of the texture.
    """
    size = 1 << log_size
    x = place * size - 0.5
    x0 = int(x)
    if x < x0:
        x0 -= 1
    return x0 & (size - 1), (x0 + 1) & (size - 1), x - x0


@inlined
def _mix(data, offset, log_width, x, y):
    """Interpolate one level of a texture; offset: its first byte; x, y: results of `_between`."""
    x0, x1, fx = x
    y0, y1, fy = y
    row0 = offset + (y0 << log_width)
    row1 = offset + (y1 << log_width)
    top = data[row0 + x0] * (1 - fx) + data[row0 + x1] * fx
    bottom = data[row1 + x0] * (1 - fx) + data[row1 + x1] * fx
    return top * (1 - fy) + bottom * fy


@inlined
def _level(step, levels):
    """Return the level for a step of that many texels, and the weight of the next level.

    The level is log2 of the step, linear in between.
    """
    level = 0
    while step >= 2.0 and level < levels:
        step *= 0.5
        level += 1
    weight = 0.0
    if level < levels and step > 1.0:
        weight = step - 1.0
    return level, weight


@inlined
def _filtered(data, start, texture, log_height, log_width, u, v, u_step, v_step):
    """Return a texture's value for a sample that covers u_step by v_step repeats.

    Neighbouring levels are blended.
    """
    i, u_part = _level(u_step * (1 << log_width), log_width)
    j, v_part = _level(v_step * (1 << log_height), log_height)
    rows, columns = log_height - j, log_width - i
    x, y = _between(u, columns), _between(v, rows)
    value = _mix(data, start[texture, j, i], columns, x, y)
    if u_part > 0.0:
        half_x = _between(u, columns - 1)
        next_value = _mix(data, start[texture, j, i + 1], columns - 1, half_x, y)
        value += u_part * (next_value - value)
    if v_part > 0.0:
        half_y = _between(v, rows - 1)
        other = _mix(data, start[texture, j + 1, i], columns, x, half_y)
        if u_part > 0.0:
            next_other = _mix(data, start[texture, j + 1, i + 1], columns - 1, half_x, half_y)
            other += u_part * (next_other - other)
        value += v_part * (other - value)
    return value


@inlined
def _place(coefficients, faces, index, row, x, w):
    """Return a sample's position u, v on a face's texture, and its steps to the next sample.

    The steps of u and v are the larger ones of both image directions. The quotient rule gives
    ds/dx = (d(w s)/dx - s dw/dx) / w.
    """
    c, f, n = coefficients, faces, index
    z = 1.0 / w
    s = (c[n, S] + c[n, S_Y] * row + c[n, S_X] * x) * z
    t = (c[n, T] + c[n, T_Y] * row + c[n, T_X] * x) * z
    s_x = (c[n, S_X] - s * c[n, W_X]) * z
    s_y = (c[n, S_Y] - s * c[n, W_Y]) * z
    t_x = (c[n, T_X] - t * c[n, W_X]) * z
    t_y = (c[n, T_Y] - t * c[n, W_Y]) * z
    u_x = f[n, U_S] * s_x + f[n, U_T] * t_x
    u_y = f[n, U_S] * s_y + f[n, U_T] * t_y
    v_x = f[n, V_S] * s_x + f[n, V_T] * t_x
    v_y = f[n, V_S] * s_y + f[n, V_T] * t_y
    u = f[n, U] + f[n, U_S] * s + f[n, U_T] * t
    v = f[n, V] + f[n, V_S] * s + f[n, V_T] * t
    return u, v, max(abs(u_x), abs(u_y)), max(abs(v_x), abs(v_y))


@inlined
def _inverse_depth(coefficients, index, row, x):
    """Return w of a face at a sample."""
    c, n = coefficients, index
    return c[n, W] + c[n, W_Y] * row + c[n, W_X] * x


@inlined
def _alpha_level(start, sides, coefficients, faces, index, row, x):
    """Return the level of a face's alpha for one row of samples: first byte, rows and columns."""
    texture = int(faces[index, TEXTURE])
    log_height, log_width = sides[texture, 0], sides[texture, 1]
    w = _inverse_depth(coefficients, index, row, x)
    _, _, u_step, v_step = _place(coefficients, faces, index, row, x, w)
    i, u_part = _level(u_step * (1 << log_width), min(ALPHA_LEVELS - 1, log_width))
    j, v_part = _level(v_step * (1 << log_height), min(ALPHA_LEVELS - 1, log_height))
    i += u_part > 0.5
    j += v_part > 0.5
    rows, columns = 1 << (log_height - j), 1 << (log_width - i)
    return start[texture, j, i] + rows * columns, rows, columns


# Which samples a face covers


@inlined
def _turn(rotation, x, y, z):
    """Rotate a vector from street to camera coordinates."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@inlined
def _cross(a, b):
    """Return the cross product of two vectors."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inlined
def _set_coefficients(c, first, vector, volume, focal, centre):
    """Fill in c[first : first + 3] for p . vector / volume, which is linear in x and y."""
    step_x = vector[0] / focal[0] / volume
    step_y = vector[1] / focal[1] / volume
    c[first] = vector[2] / volume - centre[0] * step_x - centre[1] * step_y
    c[first + 1] = step_x
    c[first + 2] = step_y


@inlined
def _set_up(corner, edge_s, edge_t, view, c):
    """Fill in the nine coefficients `c` of a face; return the first and last row that it may cover.

    The rows are (0, -1) for a face that cannot be seen. corner, edge_s and edge_t are in camera
    coordinates.
    """
    focal, centre = view.focal, view.centre
    height, width = view.size
    behind = 0
    x_min = y_min = 1e30
    x_max = y_max = -1e30
    for k in range(4):
        s, t = float(k & 1), float(k >> 1)
        x = corner[0] + s * edge_s[0] + t * edge_t[0]
        y = corner[1] + s * edge_s[1] + t * edge_t[1]
        z = corner[2] + s * edge_s[2] + t * edge_t[2]
        if z < NEAR:
            behind += 1
        else:
            px = focal[0] * x / z + centre[0]
            py = focal[1] * y / z + centre[1]
            x_min, x_max = min(x_min, px), max(x_max, px)
            y_min, y_max = min(y_min, py), max(y_max, py)
    if behind == 4:
        return 0, -1
    if behind:
        y_min, y_max = 0.0, height - 1.0
    elif x_max < 0 or x_min > width - 1 or y_max < 0 or y_min > height - 1:
        return 0, -1
    normal = _cross(edge_s, edge_t)
    volume = corner[0] * normal[0] + corner[1] * normal[1] + corner[2] * normal[2]
    if abs(volume) < 1e-9:  # seen edge-on
        return 0, -1
    _set_coefficients(c, S, _cross(edge_t, corner), volume, focal, centre)
    _set_coefficients(c, T, _cross(corner, edge_s), volume, focal, centre)
    _set_coefficients(c, W, normal, volume, focal, centre)
    return max(0, math.ceil(y_min)), min(height - 1, math.floor(y_max))


@inlined
def _narrow(value, slope, low, high):
    """Return the part of [low, high] where value + slope x >= 0."""
    if slope > 0:
        low = max(low, -value / slope)
    elif slope < 0:
        high = min(high, -value / slope)
    elif value < 0:
        high = low - 1.0
    return low, high


@inlined
def _span(c, triangle, row, width):
    """Return the first and last sample of a row inside a face.

    Inside, z > NEAR, s >= 0, t >= 0, and s, t or s + t <= 1.
    """
    ws = c[S] + c[S_Y] * row
    wt = c[T] + c[T_Y] * row
    w = c[W] + c[W_Y] * row
    low, high = 0.0, width - 1.0
    # neighbouring faces overlap by this share of their edges, so no crack opens between them
    slack = 1e-7
    low, high = _narrow(w - 1e-6, c[W_X], low, high)
    low, high = _narrow(1.0 / NEAR - w, -c[W_X], low, high)
    low, high = _narrow(ws + slack * w, c[S_X] + slack * c[W_X], low, high)
    low, high = _narrow(wt + slack * w, c[T_X] + slack * c[W_X], low, high)
    end, end_x = (1 + slack) * w, (1 + slack) * c[W_X]
    if triangle:
        low, high = _narrow(end - ws - wt, end_x - c[S_X] - c[T_X], low, high)
    else:
        low, high = _narrow(end - ws, end_x - c[S_X], low, high)
        low, high = _narrow(end - wt, end_x - c[T_X], low, high)
    if high < low:
        return 0, -1
    return math.ceil(low), math.floor(high)


@compiled
def _draw(faces, textures, view, coefficients, depth, nearest):
    """Find the nearest face at each sample.

    Fills `depth` (w), `nearest` (row of `faces`) and `coefficients`. A face is drawn only where its
    w is larger than the value in `depth`.
    """
    data, start, sides, cut_out = textures.data, textures.start, textures.sides, textures.cut_out
    rotation, position, width = view.rotation, view.position, view.size[1]
    for index in range(faces.shape[0]):
        face, c = faces[index], coefficients[index]
        corner = _turn(
            rotation,
            face[CORNER + X] - position[X],
            face[CORNER + Y] - position[Y],
            face[CORNER + Z] - position[Z],
        )
        edge_s = _turn(rotation, face[EDGE_S + X], face[EDGE_S + Y], face[EDGE_S + Z])
        edge_t = _turn(rotation, face[EDGE_T + X], face[EDGE_T + Y], face[EDGE_T + Z])
        first_row, last_row = _set_up(corner, edge_s, edge_t, view, c)
        has_alpha = cut_out[int(face[TEXTURE])]
        triangle = face[TRIANGLE] > 0
        for row in range(first_row, last_row + 1):
            first, last = _span(c, triangle, row, width)
            if last < first:
                continue
            w_row, w_x = c[W] + c[W_Y] * row, c[W_X]
            if has_alpha:
                offset, rows, columns = _alpha_level(
                    start, sides, coefficients, faces, index, row, (first + last) // 2
                )
                for x in range(first, last + 1):
                    w = w_row + w_x * x
                    if w > depth[row, x]:
                        u, v, _, _ = _place(coefficients, faces, index, row, x, w)
                        texel_row = math.floor(v * rows) & (rows - 1)
                        texel_column = math.floor(u * columns) & (columns - 1)
                        if data[offset + texel_row * columns + texel_column] >= OPAQUE:
                            depth[row, x] = w
                            nearest[row, x] = index
            else:
                depths = depth[row, first : last + 1]
                hits = nearest[row, first : last + 1]
                for k in range(len(depths)):  # a loop from 0 is vectorised
                    w = w_row + w_x * (first + k)
                    if w > depths[k]:
                        depths[k] = w
                        hits[k] = index


def _shadows(faces: np.ndarray, sun: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the shadows of faces on the ground y = 0, as faces.

    A point p casts its shadow at p - sun p_y / sun_y. This is linear, so the shadow of a face has a
    corner, edge_s and edge_t, with the same (s, t) and so the same alpha.
    """
    away = np.hypot(faces[:, CORNER + X] - position[X], faces[:, CORNER + Z] - position[Z])
    shadows = faces[(faces[:, GROUND] == 0) & (away < SHADOW_FAR)]
    for column in (CORNER, EDGE_S, EDGE_T):
        shadows[:, column : column + 3] -= shadows[:, column + Y, None] / sun[Y] * sun
    return shadows


# From samples to pixels


@inlined
def _most(labels, depths):
    """Return the most frequent label of a pixel's samples.

    Of two equally frequent ones, it is the nearer surface's.
    """
    best, best_count, best_depth = labels[0], 0, -1.0
    for k in range(4):
        count, closest = 0, 0.0
        for m in range(4):
            if labels[m] == labels[k]:
                count += 1
                closest = max(closest, depths[m])
        nearer = count == best_count and closest > best_depth
        if count > best_count or nearer:
            best, best_count, best_depth = labels[k], count, closest
    return best


def render(
    faces: np.ndarray,
    textures: Textures,
    pose: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    environment: Environment,
) -> tuple[np.ndarray, np.ndarray]:
    """Render one view: an image before exposure and noise, and a label map.

    The image is float32 (height, width), the label map uint8 alike. faces: (n, FACE_COLUMNS)
    float64; pose: 4x4 camera-to-world; intrinsics: 3x3 in pixels whose centres have whole
    coordinates; size: (height, width).
    """
    edge_s = faces[:, EDGE_S : EDGE_S + 3]
    edge_t = faces[:, EDGE_T : EDGE_T + 3]
    middle = faces[:, CORNER : CORNER + 3] + 0.5 * (edge_s + edge_t) - pose[:3, 3]
    # Near faces are drawn first, so most hidden samples cost one comparison.
    order = np.argsort((middle * middle).sum(axis=1), kind="stable")
    faces = faces[order]
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    centre = np.array([intrinsics[0, 2], intrinsics[1, 2]])
    view = View(
        rotation=np.ascontiguousarray(pose[:3, :3].T),
        position=np.ascontiguousarray(pose[:3, 3]),
        focal=focal * SUPERSAMPLING,
        # Sample 0 lies a quarter pixel before the centre of pixel 0.
        centre=(centre + 0.5) * SUPERSAMPLING - 0.5,
        size=(size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING),
    )
    depth = np.zeros(view.size, np.float32)
    nearest = np.full(view.size, -1, np.int32)
    coefficients = np.empty((len(faces), 9))
    _draw(faces, textures, view, coefficients, depth, nearest)
    # the appended value is for samples without a face
    on_ground = np.append(faces[:, GROUND] > 0, False)[nearest]
    shadows = _shadows(faces, environment.sun, view.position)
    shadow = np.full(view.size, -1, np.int32)
    ground_depth = np.where(on_ground, 0, np.inf).astype(np.float32)
    _draw(shadows, textures, view, np.empty((len(shadows), 9)), ground_depth, shadow)
    brightness = _brightness(faces, environment)
    return _pixels(faces, brightness, textures, environment, coefficients, nearest, shadow)


def _brightness(faces: np.ndarray, environment: Environment) -> np.ndarray:
    """Return the factor of each face's texture, (n,).

    It is the ambient light plus the sun by the cosine of its angle.
    """
    normal = np.cross(faces[:, EDGE_S : EDGE_S + 3], faces[:, EDGE_T : EDGE_T + 3])
    length = np.sqrt((normal * normal).sum(axis=1))
    cosine = -(normal * environment.sun).sum(axis=1) / np.maximum(length, 1e-12)
    direct = np.where(faces[:, LIT] > 0, np.maximum(cosine, 0.0), UNLIT)
    return faces[:, GAIN] * (environment.ambient + environment.direct * direct)


@compiled
def _pixels(faces, brightness, textures, environment, coefficients, nearest, shadow):
    """Return image and label map from the nearest face and the shadow at each sample."""
    height, width = nearest.shape[0] // SUPERSAMPLING, nearest.shape[1] // SUPERSAMPLING
    image = np.empty((height, width), np.float32)
    label_map = np.empty((height, width), np.uint8)
    labels, depths = np.empty(4, np.uint8), np.empty(4)
    data, start, sides = textures.data, textures.start, textures.sides
    dark, haze, horizon = 1.0 - environment.shadow, environment.haze, environment.horizon
    for i in range(height):
        for j in range(width):
            index, shaded = nearest[2 * i, 2 * j], 0
            # most pixels show one face, whose texture is read once, at the pixel's centre
            whole = True
            for k in range(4):
                y, x = 2 * i + (k >> 1), 2 * j + (k & 1)
                whole &= nearest[y, x] == index
                shaded += shadow[y, x] >= 0
            reads, shift, spread = 4, 0.0, SHARPNESS
            if whole:
                reads, shift, spread = 1, 0.5, 2 * SHARPNESS
            total = 0.0
            for k in range(reads):
                y, x = 2 * i + (k >> 1), 2 * j + (k & 1)
                index = nearest[y, x]
                labels[k], depths[k] = SKY, 0.0
                if index < 0:
                    total += horizon
                    continue
                row, column = y + shift, x + shift
                w = _inverse_depth(coefficients, index, row, column)
                u, v, u_step, v_step = _place(coefficients, faces, index, row, column, w)
                u_step *= spread
                v_step *= spread
                texture = int(faces[index, TEXTURE])
                log_height, log_width = sides[texture, 0], sides[texture, 1]
                value = _filtered(data, start, texture, log_height, log_width, u, v, u_step, v_step)
                if faces[index, GROUND] > 0:
                    value *= 1.0 - dark * shaded / 4
                clear = math.exp(-haze / w)
                total += value * brightness[index] * clear + horizon * (1 - clear)
                labels[k], depths[k] = int(faces[index, LABEL]), w
            image[i, j] = total / reads
            if whole:
                label_map[i, j] = labels[0]
            else:
                label_map[i, j] = _most(labels, depths)
    return image, label_map
