"""A small z-buffer rasteriser of textured faces: gray images with label maps that are exact to the pixel.

A face is a parallelogram or a triangle given by a corner and two edges. Where it meets a pixel's ray, the inverse
depth w and the products w s, w t with the position (s, t) along its edges are linear in the pixel coordinates, so no
face has to be clipped and every sample is exact. Image and label map come from the same 2x2 samples a pixel: the image
is their mean, the label is that of most of them (of the nearest surface where they are even).

Coordinates are those of KITTI: x right, y down, z forward, metres. No fast-math and no threads: the same input gives
the same bytes whatever runs beside it.
"""

import math

import numba
import numpy as np

# Columns of the face matrix.
CORNER, EDGE_S, EDGE_T = 0, 3, 6  # three each
UV = 9  # u = f[9] + f[10] s + f[11] t and v = f[12] + f[13] s + f[14] t, in repeats of the texture
TEXTURE, LABEL, GAIN = 15, 16, 17
TRIANGLE = 18  # 1: s + t <= 1; 0: parallelogram
GROUND = 19  # which ground level the face is part of: 0 none, 1 road, 2 sidewalk; only the ground receives shadows
CASTS = 20  # 1: casts a shadow
LIT = 21  # 1: shaded by its outward normal (edge_s x edge_t), 0: evenly, as leaves and grass
COLUMNS = 22

GROUND_LEVELS = np.array([0.0, 0.0, -0.12])  # y of the two ground levels; the first entry is a filler

# Entries of the environment vector.
SUN = 0  # three: direction of travel of the light, unit length, y > 0
AMBIENT, DIRECT, SHADOW, ZENITH, HORIZON, CLOUDS, HAZE = 3, 4, 5, 6, 7, 8, 9
ENVIRONMENT = 10

NEAR = 0.25  # metres
FAR = 220.0
SHADOW_FAR = 70.0
LEVELS = 12  # sides up to 2048
ALPHA_LEVELS = 5  # thinner than that, cut-outs flicker rather than vanish
SUPERSAMPLING = 2
OPAQUE = 128
COUNTED = -2  # a sample that is dealt with; -1 is the background
SHARPNESS = 0.75  # part of a pixel that a texture is averaged over; the rest is contrast against a little aliasing


def _jit(function):
    # numpy's error model: no check for division by zero in the inner loops.
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # no folder that numba may write its cache to
        return numba.njit(error_model="numpy")(function)


class Textures:
    """Textures packed for the rasteriser: uint8 gray, sides powers of two, each reduced along u and v separately.

    Reducing the two axes separately keeps a road that is seen at a flat angle sharp across its markings without
    aliasing along them.
    """

    def __init__(self):
        self.names = {}
        self._chunks, self._length = [], 0
        self._gray, self._alpha, self._sides = [], [], []

    def add(self, name, gray, alpha=None):
        height, width = gray.shape
        if height & (height - 1) or width & (width - 1):
            raise ValueError(f"texture {name}: sides {gray.shape} are not powers of two")
        self.names[name] = len(self.names)
        self._sides.append((height.bit_length() - 1, width.bit_length() - 1))
        self._gray.append(self._pack(gray, coverage=False))
        self._alpha.append(np.full((LEVELS, LEVELS), -1, np.int64) if alpha is None
                           else self._pack(alpha, coverage=True))

    def _pack(self, texture, coverage):
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

    def packed(self):
        """(data, gray offsets, alpha offsets, log2 sides) for `render`."""
        return (np.concatenate(self._chunks), np.array(self._gray), np.array(self._alpha),
                np.array(self._sides, np.int64))


@_jit
def _sample(data, offset, log_height, log_width, u, v):
    width, height = 1 << log_width, 1 << log_height
    x, y = u * width - 0.5, v * height - 0.5
    x0, y0 = int(x), int(y)
    if x < x0:
        x0 -= 1
    if y < y0:
        y0 -= 1
    fx, fy = x - x0, y - y0
    x0, y0 = x0 & (width - 1), y0 & (height - 1)
    x1, y1 = (x0 + 1) & (width - 1), (y0 + 1) & (height - 1)
    row0, row1 = offset + (y0 << log_width), offset + (y1 << log_width)
    top = data[row0 + x0] * (1 - fx) + data[row0 + x1] * fx
    bottom = data[row1 + x0] * (1 - fx) + data[row1 + x1] * fx
    return top * (1 - fy) + bottom * fy


@_jit
def _level(step, levels):
    """Which reduced level suits a step of so many texels, and the part of the next one: log2, linear between powers."""
    level = 0
    while step >= 2.0 and level < levels:
        step *= 0.5
        level += 1
    return level, (step - 1.0 if level < levels and step > 1.0 else 0.0)


@_jit
def _filtered(data, gray, texture, log_height, log_width, u, v, u_step, v_step):
    """Texture value for a sample that covers u_step by v_step repeats; blends neighbouring levels of both axes."""
    i, u_part = _level(u_step * (1 << log_width), log_width)
    j, v_part = _level(v_step * (1 << log_height), log_height)
    value = _sample(data, gray[texture, j, i], log_height - j, log_width - i, u, v)
    if u_part > 0.0:
        value += u_part * (_sample(data, gray[texture, j, i + 1], log_height - j, log_width - i - 1, u, v) - value)
    if v_part > 0.0:
        other = _sample(data, gray[texture, j + 1, i], log_height - j - 1, log_width - i, u, v)
        if u_part > 0.0:
            other += u_part * (_sample(data, gray[texture, j + 1, i + 1], log_height - j - 1, log_width - i - 1, u, v)
                               - other)
        value += v_part * (other - value)
    return value


@_jit
def _steps(coefficients, faces, index, s, t, w):
    """How far u and v move from one sample to the next, the larger of both image directions.

    Whole matrices and an index: a row taken out of a matrix is counted as a reference, which costs more than the work.
    """
    c, f, n, z = coefficients, faces, index, 1.0 / w
    s_x, s_y = (c[n, 1] - s * c[n, 7]) * z, (c[n, 2] - s * c[n, 8]) * z
    t_x, t_y = (c[n, 4] - t * c[n, 7]) * z, (c[n, 5] - t * c[n, 8]) * z
    u_step = max(abs(f[n, UV + 1] * s_x + f[n, UV + 2] * t_x), abs(f[n, UV + 1] * s_y + f[n, UV + 2] * t_y))
    v_step = max(abs(f[n, UV + 4] * s_x + f[n, UV + 5] * t_x), abs(f[n, UV + 4] * s_y + f[n, UV + 5] * t_y))
    return u_step, v_step


@_jit
def _alpha_level(sides, coefficients, faces, index, row, x):
    """Levels (along v and u) of a face's alpha texture that suit one row of it."""
    c, n, texture = coefficients, index, int(faces[index, TEXTURE])
    w = c[n, 6] + c[n, 8] * row + c[n, 7] * x
    u_step, v_step = _steps(c, faces, n, (c[n, 0] + c[n, 2] * row + c[n, 1] * x) / w,
                            (c[n, 3] + c[n, 5] * row + c[n, 4] * x) / w, w)
    i = j = 0
    u_step *= 1 << sides[texture, 1]
    v_step *= 1 << sides[texture, 0]
    while u_step > 1.5 and i < min(ALPHA_LEVELS - 1, sides[texture, 1]):
        u_step *= 0.5
        i += 1
    while v_step > 1.5 and j < min(ALPHA_LEVELS - 1, sides[texture, 0]):
        v_step *= 0.5
        j += 1
    return j, i


@_jit
def _opaque(data, offset, log_height, log_width, face, c, row, x, w):
    a, b, z = c[0] + c[2] * row + c[1] * x, c[3] + c[5] * row + c[4] * x, 1.0 / w
    u = face[UV] + (face[UV + 1] * a + face[UV + 2] * b) * z
    v = face[UV + 3] + (face[UV + 4] * a + face[UV + 5] * b) * z
    return _sample(data, offset, log_height, log_width, u, v) >= OPAQUE


@_jit
def _set_up(corner, edge_s, edge_t, focal, centre, size, c):
    """Coefficients of w s, w t and w over the samples, and the rows that the face may cover (empty: none).

    corner, edge_s and edge_t are in camera coordinates; `c` receives nine numbers (value, step in x, step in y).
    """
    height, width = size
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
    nx, ny, nz = sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx
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


@_jit
def _narrow(value, slope, low, high):
    """Keep the part of [low, high] where value + slope x >= 0."""
    if slope > 0:
        low = max(low, -value / slope)
    elif slope < 0:
        high = min(high, -value / slope)
    elif value < 0:
        high = low - 1.0
    return low, high


@_jit
def _span(c, triangle, row, width):
    """First and last sample of a row inside the face."""
    a, b, w = c[0] + c[2] * row, c[3] + c[5] * row, c[6] + c[8] * row
    low, high = 0.0, width - 1.0
    slack = 1e-7  # neighbours overlap by this part of their edges, so that no crack opens between them
    low, high = _narrow(w - 1e-6, c[7], low, high)
    low, high = _narrow(1.0 / NEAR - w, -c[7], low, high)
    low, high = _narrow(a + slack * w, c[1] + slack * c[7], low, high)
    low, high = _narrow(b + slack * w, c[4] + slack * c[7], low, high)
    if triangle:
        low, high = _narrow((1 + slack) * w - a - b, (1 + slack) * c[7] - c[1] - c[4], low, high)
    else:
        low, high = _narrow((1 + slack) * w - a, (1 + slack) * c[7] - c[1], low, high)
        low, high = _narrow((1 + slack) * w - b, (1 + slack) * c[7] - c[4], low, high)
    if high < low:
        return 0, -1
    return math.ceil(low), math.floor(high)


@_jit
def _surfaces(faces, data, alpha, sides, rotation, position, focal, centre, size, coefficients, depth, nearest):
    corner, edge_s, edge_t = np.empty(3), np.empty(3), np.empty(3)
    for index in range(faces.shape[0]):
        face = faces[index]
        for k in range(3):
            corner[k] = edge_s[k] = edge_t[k] = 0.0
            for m in range(3):
                corner[k] += rotation[k, m] * (face[CORNER + m] - position[m])
                edge_s[k] += rotation[k, m] * face[EDGE_S + m]
                edge_t[k] += rotation[k, m] * face[EDGE_T + m]
        c = coefficients[index]
        first_row, last_row = _set_up(corner, edge_s, edge_t, focal, centre, size, c)
        if last_row < first_row:
            continue
        texture = int(face[TEXTURE])
        cut_out = alpha[texture, 0, 0] >= 0
        triangle = face[TRIANGLE] > 0
        for row in range(first_row, last_row + 1):
            start, stop = _span(c, triangle, row, size[1])
            if stop < start:
                continue
            if cut_out:
                j, i = _alpha_level(sides, coefficients, faces, index, row, (start + stop) // 2)
                offset, log_height, log_width = alpha[texture, j, i], sides[texture, 0] - j, sides[texture, 1] - i
                for x in range(start, stop + 1):
                    w = c[6] + c[8] * row + c[7] * x
                    if w > depth[row, x] and _opaque(data, offset, log_height, log_width, face, c, row, x, w):
                        depth[row, x] = w
                        nearest[row, x] = index
            else:
                for x in range(start, stop + 1):
                    w = c[6] + c[8] * row + c[7] * x
                    if w > depth[row, x]:
                        depth[row, x] = w
                        nearest[row, x] = index


@_jit
def _shadows(faces, data, alpha, sides, rotation, position, focal, centre, size, levels, sun, nearest, shadow):
    """Mark the ground samples that a face shades: its parallel projection on each ground level, drawn as a face."""
    corner, edge_s, edge_t = np.empty(3), np.empty(3), np.empty(3)
    flat_corner, flat_s, flat_t = np.empty(3), np.empty(3), np.empty(3)
    coefficients = np.empty((faces.shape[0], 9))
    for index in range(faces.shape[0]):
        face, c = faces[index], coefficients[index]
        if face[CASTS] == 0:
            continue
        distance = math.hypot(face[CORNER] - position[0], face[CORNER + 2] - position[2])
        if distance > SHADOW_FAR:
            continue
        texture = int(face[TEXTURE])
        cut_out = alpha[texture, 0, 0] >= 0
        triangle = face[TRIANGLE] > 0
        for level in range(1, len(levels)):
            fall = (levels[level] - face[CORNER + 1]) / sun[1]
            for k in range(3):
                flat_corner[k] = face[CORNER + k] + sun[k] * fall - position[k]
                flat_s[k] = face[EDGE_S + k] - sun[k] * face[EDGE_S + 1] / sun[1]
                flat_t[k] = face[EDGE_T + k] - sun[k] * face[EDGE_T + 1] / sun[1]
            for k in range(3):
                corner[k] = edge_s[k] = edge_t[k] = 0.0
                for m in range(3):
                    corner[k] += rotation[k, m] * flat_corner[m]
                    edge_s[k] += rotation[k, m] * flat_s[m]
                    edge_t[k] += rotation[k, m] * flat_t[m]
            first_row, last_row = _set_up(corner, edge_s, edge_t, focal, centre, size, c)
            for row in range(first_row, last_row + 1):
                start, stop = _span(c, triangle, row, size[1])
                if stop < start:
                    continue
                if cut_out:
                    j, i = _alpha_level(sides, coefficients, faces, index, row, (start + stop) // 2)
                    offset, log_height, log_width = alpha[texture, j, i], sides[texture, 0] - j, sides[texture, 1] - i
                for x in range(start, stop + 1):
                    if shadow[row, x] or nearest[row, x] < 0 or faces[nearest[row, x], GROUND] != level:
                        continue
                    if cut_out:
                        w = c[6] + c[8] * row + c[7] * x
                        if not _opaque(data, offset, log_height, log_width, face, c, row, x, w):
                            continue
                    shadow[row, x] = True


@_jit
def _surface_value(faces, coefficients, index, row, column, w, spread, data, gray, sides):
    """Texture of a face at a place (in samples), averaged over a square of `spread` samples."""
    c, f, n, texture = coefficients, faces, index, int(faces[index, TEXTURE])
    s = (c[n, 0] + c[n, 2] * row + c[n, 1] * column) / w
    t = (c[n, 3] + c[n, 5] * row + c[n, 4] * column) / w
    u_step, v_step = _steps(c, f, n, s, t, w)
    u = f[n, UV] + f[n, UV + 1] * s + f[n, UV + 2] * t
    v = f[n, UV + 3] + f[n, UV + 4] * s + f[n, UV + 5] * t
    return _filtered(data, gray, texture, sides[texture, 0], sides[texture, 1], u, v, u_step * spread, v_step * spread)


@_jit
def _background(x, y, rotation, environment, horizon, horizon_labels, data, gray, sides, cloud_texture, leaf_texture,
                ground_label):
    """Value and label where no face is: the sky with its clouds, the skyline and the ground far away."""
    right = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0]
    down = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1]
    ahead = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2]
    azimuth = math.atan2(right, ahead)
    elevation = -down / math.hypot(right, ahead)
    place = (azimuth + math.pi) * len(horizon) / (2 * math.pi)
    first = int(place) % len(horizon)
    part = place - math.floor(place)
    skyline = horizon[first] * (1 - part) + horizon[(first + 1) % len(horizon)] * part
    sky = environment[HORIZON]
    if elevation > skyline:
        clouds = _sample(data, gray[cloud_texture, 0, 0], sides[cloud_texture, 0], sides[cloud_texture, 1],
                         azimuth / math.pi, -elevation) - 128.0
        blue = math.sqrt(min(1.0, elevation / 0.6))
        return sky + (environment[ZENITH] - sky) * blue + clouds * environment[CLOUDS], 23
    if elevation > -0.01:
        leaves = _sample(data, gray[leaf_texture, 0, 0], sides[leaf_texture, 0], sides[leaf_texture, 1],
                         azimuth * 3.0, -elevation * 3.0)
        return 0.35 * leaves + 0.42 * sky, horizon_labels[first]
    return 0.75 * sky, ground_label


@_jit
def _most(labels, counts, depths, found):
    """The label of most samples; where two have as many, that of the nearer surface."""
    best, best_count, best_depth = labels[0], 0.0, -1.0
    for k in range(found):
        count, closest = 0.0, 0.0
        for m in range(found):
            if labels[m] == labels[k]:
                count += counts[m]
                closest = max(closest, depths[m])
        if count > best_count or (count == best_count and closest > best_depth):
            best, best_count, best_depth = labels[k], count, closest
    return best


@_jit
def _render(faces, brightness, data, gray, alpha, sides, rotation, position, focal, centre, height, width, environment,
            horizon, horizon_labels, cloud_texture, leaf_texture, ground_label):
    size = (height * SUPERSAMPLING, width * SUPERSAMPLING)
    depth = np.full(size, 1.0 / FAR, np.float32)
    nearest = np.full(size, -1, np.int32)
    shadow = np.zeros(size, np.bool_)
    coefficients = np.empty((faces.shape[0], 9))
    _surfaces(faces, data, alpha, sides, rotation, position, focal, centre, size, coefficients, depth, nearest)
    _shadows(faces, data, alpha, sides, rotation, position, focal, centre, size, GROUND_LEVELS,
             environment[SUN:SUN + 3], nearest, shadow)
    image = np.empty((height, width), np.float32)
    label_map = np.empty((height, width), np.uint8)
    hits, counts, labels, depths = np.empty(4, np.int64), np.empty(4), np.empty(4, np.uint8), np.empty(4)
    dark = 1.0 - environment[SHADOW]
    for i in range(height):
        for j in range(width):
            # The texture of each face in the pixel is read once, in the middle of its samples.
            found, total = 0, 0.0
            for k in range(4):
                hits[k] = nearest[2 * i + (k >> 1), 2 * j + (k & 1)]
            for k in range(4):
                index = hits[k]
                if index == COUNTED:
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
                    w = coefficients[index, 6] + coefficients[index, 8] * y + coefficients[index, 7] * x
                    spread = SHARPNESS * math.sqrt(count)
                    value = _surface_value(faces, coefficients, index, y, x, w, spread, data, gray, sides)
                    value *= brightness[index] * (1.0 - dark * shaded / count)
                    clear = math.exp(-environment[HAZE] / w)
                    value = value * clear + environment[HORIZON] * (1 - clear)
                    label = int(faces[index, LABEL])
                else:
                    value, label = _background((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], rotation,
                                               environment, horizon, horizon_labels, data, gray, sides, cloud_texture,
                                               leaf_texture, ground_label)
                    w = 0.0
                total += count * value
                labels[found], counts[found], depths[found] = label, count, w
                found += 1
            image[i, j] = total * 0.25
            label_map[i, j] = _most(labels, counts, depths, found)
    return image, label_map


def brightness(faces, environment):
    """How bright each face's texture is shown: ambient light and the sun by the cosine of its angle."""
    normal = np.cross(faces[:, EDGE_S:EDGE_S + 3], faces[:, EDGE_T:EDGE_T + 3])
    length = np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2 + normal[:, 2] ** 2)
    sun = environment[SUN:SUN + 3]
    cosine = -(normal[:, 0] * sun[0] + normal[:, 1] * sun[1] + normal[:, 2] * sun[2]) / np.maximum(length, 1e-12)
    direct = np.where(faces[:, LIT] > 0, np.maximum(cosine, 0.0), 0.6)
    return faces[:, GAIN] * (environment[AMBIENT] + environment[DIRECT] * direct)


def render(faces, textures, pose, intrinsics, size, environment, horizon, horizon_labels, ground_label=22):
    """Render one view: image float32 (height, width) before exposure and noise, and label map uint8 (height, width).

    faces: (n, COLUMNS) matrix; textures: (names, packed arrays); pose: 4x4 camera-to-world; intrinsics: 3x3 in pixels
    whose centres have whole coordinates; horizon: elevation (tangent) of the skyline over the azimuth, with its labels.
    """
    names, packed = textures
    # From near to far, so that most of what is hidden costs one comparison.
    middle = faces[:, :3] + 0.5 * (faces[:, 3:6] + faces[:, 6:9]) - pose[:3, 3]
    faces = faces[np.argsort((middle * middle).sum(axis=1), kind="stable")]
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]]) * SUPERSAMPLING
    # Sample 0 of pixel 0 lies a quarter pixel before its centre.
    centre = (np.array([intrinsics[0, 2], intrinsics[1, 2]]) + 0.5) * SUPERSAMPLING - 0.5
    return _render(faces, brightness(faces, environment), *packed, np.ascontiguousarray(pose[:3, :3].T),
                   np.ascontiguousarray(pose[:3, 3]), focal, centre, size[0], size[1], environment, horizon,
                   horizon_labels, names["clouds"], names["leaves"], ground_label)


def compile_for_all():
    """Compile once and keep it on disk where possible, so that the processes started afterwards need not."""
    nothing = np.zeros((0, COLUMNS))
    packed = (np.zeros(1, np.uint8), np.zeros((1, LEVELS, LEVELS), np.int64), np.full((1, LEVELS, LEVELS), -1),
              np.zeros((1, 2), np.int64))
    render(nothing, ({"clouds": 0, "leaves": 0}, packed), np.eye(4), np.eye(3), (1, 1), np.ones(ENVIRONMENT),
           np.zeros(2), np.zeros(2, np.uint8))
