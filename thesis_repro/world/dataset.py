"""The embedded world: rendered street drives with exact poses and label maps, written in the two real file layouts.

OUT/kitti is laid out as the KITTI odometry benchmark (plus sequences/NN/labels_0, the exact label map of every frame),
OUT/cityscapes as Cityscapes; its images show other streets than the sequences. Each picture depends on the seed and
its own name alone, so that neither the number of processes nor an interruption changes a byte.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from joblib import Parallel, cpu_count, delayed

from thesis_repro import InputError, kitti, stages
from thesis_repro.cityscapes import ID
from thesis_repro.files import progress, write_png, write_text
from thesis_repro.world import render, street, textures
from thesis_repro.world.street import AHEAD, BEHIND, STEP, Style, Track

SEQUENCES = tuple(kitti.CAMERAS)
FRAME_TIME = 0.1  # seconds; KITTI records at 10 Hz
BASELINE = 0.537  # metres between KITTI's cameras, for the calibration file's P1 and P3
CAMERA_HEIGHT = 1.65
TURN_RATE = np.radians(3.6)  # a driver slows down for more than this a frame
ACCELERATION = 0.03  # metres a frame, a frame: 3 m/s^2
IMAGE_SIZE = (512, 1024)  # of the training images at scale 1
TRAIN_CITIES = ("birkenstadt", "fuchsheim", "morgental", "silberau", "tannfeld")
VALIDATION_CITIES = ("nebelburg", "quellheim")


@dataclass(frozen=True)
class Drive:
    """One sequence: the road's pieces (metres, degrees to the right), the pace (metres a frame) and the look."""

    pieces: tuple
    pace: float
    style: Style
    lane: float = 1.7  # metres right of the road's middle
    stops: bool = False
    noise: float = 2.0
    level: float = 104.0  # the mean gray that the exposure aims at


_CITY = ("blocks", "houses", "park", "wall")
_GREEN = ("houses", "park", "wall", "field")
_OPEN = ("field", "park", "houses")

DRIVES = {
    # City with right-angled turns both ways.
    "00": Drive(((18, 0), (15, 90), (30, 0), (15, 90), (26, 0), (15, -90), (40, 0)), 0.9,
                Style(sun=(0.7, 0.75), sky=(140, 190, 0.25))),
    # Highway: fast, wide, little texture, cars that overtake.
    "01": Drive(((40, 0), (90, 14), (60, 0), (80, -18)), 1.5,
                Style(half=7.5, road="highway", parking=(0, 0), zones=("field", "park"), weights=(0.8, 0.2),
                      sun=(-1.0, 0.9), sky=(170, 225, 0.5), haze=0.004, bridge=95.0), lane=0.0, noise=1.6, level=122),
    # Suburb of S-curves.
    "02": Drive(((10, 0), (28, 50), (12, 0), (34, -75), (15, 0), (26, 45)), 1.0,
                Style(half=3.6, road="lane", parking=(0, 0), zones=_GREEN, weights=(0.5, 0.3, 0.1, 0.1), trees=0.7,
                      sun=(2.4, 0.7), sky=(150, 200, 0.6)), noise=2.2),
    # Lane between fields and gardens in long bends.
    "03": Drive(((8, 0), (40, -38), (30, 22), (45, 40), (30, -28)), 0.85,
                Style(half=3.3, parking=(0, 0), sidewalk=1.6, zones=_OPEN, weights=(0.35, 0.4, 0.25), trees=0.3,
                      sunny=False, sky=(185, 228, 0.8), haze=0.006, persons=0.02), lane=1.6, noise=2.6),
    # Straight on behind another car.
    "04": Drive(((200, 0),), 1.3, Style(half=4.2, parking=(2.2, 0), zones=_CITY, weights=(0.4, 0.2, 0.3, 0.1),
                                        leader=22.0, traffic=0.02, sun=(-0.6, 0.6), sky=(135, 180, 0.3)), noise=1.8),
    # Old town with one turn to the left and one to the right.
    "05": Drive(((14, 0), (16, -90), (34, 0), (15, 90), (25, 0), (24, 50)), 0.75,
                Style(half=3.6, sidewalk=2.2, parking=(2.2, 0), zones=_CITY, weights=(0.75, 0.1, 0.1, 0.05), trees=0.2,
                      persons=0.1, sunny=False, sky=(175, 222, 0.7)), noise=2.4),
    # Up a wide street, round its end and back beside it.
    "06": Drive(((30, 0), (13, 90), (7, 0), (13, 90), (40, 0), (13, 90), (7, 0), (13, 90), (10, 0)), 1.05,
                Style(half=4.0, parking=(0, 0), zones=("park", "houses", "field"), weights=(0.6, 0.25, 0.15), trees=1.0,
                      sun=(0.2, 0.55), sky=(120, 165, 0.2)), noise=1.6),
    # Waits while others cross.
    "07": Drive(((60, 0), (15, 90), (40, 0), (15, 90)), 0.8,
                Style(parking=(2.2, 2.2), sun=(1.9, 0.8), sky=(150, 205, 0.5), crossing=30.0, parked=0.45,
                      traffic=0.004), stops=True, noise=2.0),
    # Residential streets: gentle bends, then a sharp one.
    "08": Drive(((12, 0), (20, 30), (14, 0), (15, -90), (20, 0), (22, -35), (25, 0)), 0.8,
                Style(zones=_CITY, weights=(0.25, 0.55, 0.1, 0.1), parking=(2.2, 2.2), parked=0.7, sun=(-2.2, 0.85),
                      sky=(155, 210, 0.6)), noise=2.2),
    # Round a small block, again and again.
    "09": Drive(((6, 0), (15, 90), (6, 0), (15, 90), (6, 0), (15, 90), (6, 0), (15, 90)), 0.7,
                Style(half=3.4, road="lane", parking=(0, 0), zones=("blocks", "houses", "park"),
                      weights=(0.45, 0.35, 0.2), sunny=False, sky=(165, 215, 0.9), haze=0.004), noise=2.4),
    # A long tightening bend through a narrow street.
    "10": Drive(((10, 0), (30, 35), (24, 50), (10, 0), (40, -60)), 0.65,
                Style(half=3.3, road="lane", sidewalk=1.8, parking=(0, 2.2), zones=_CITY, weights=(0.5, 0.2, 0.1, 0.2),
                      sun=(1.2, 0.65), sky=(130, 175, 0.3)), lane=1.3, noise=2.8, level=96),
}


@dataclass
class Scene:
    """A street with the camera's way along it: scene poses, and the way driven (metres) at each frame."""

    street: street.Street
    poses: np.ndarray
    driven: np.ndarray
    intrinsics: np.ndarray
    size: tuple


def _rng(*key):
    return np.random.default_rng(np.random.SeedSequence(key))


def scaled_camera(name, scale):
    """Size (height, width) and intrinsics of a sequence's camera at a scale.

    Whole coordinates are pixel centres, so the principal point moves by half a pixel before and after scaling.
    """
    camera = kitti.CAMERAS[name]
    width, height = round(camera.width * scale), round(camera.height * scale)
    x, y = width / camera.width, height / camera.height
    return (height, width), np.array([[camera.fx * x, 0, (camera.cx + 0.5) * x - 0.5],
                                      [0, camera.fy * y, (camera.cy + 0.5) * y - 0.5], [0, 0, 1.0]])


def _driven(drive, track, frames, phase):
    """Metres along the road at each frame: the pace, slower before and in bends, and the stops."""
    limit = drive.pace * (1 + 0.12 * np.sin(track.s / 11 + phase))
    limit = np.minimum(limit, TURN_RATE / np.maximum(np.abs(track.curvature), 1e-9))
    gain = 2 * ACCELERATION * STEP
    for k in range(len(limit) - 2, -1, -1):
        limit[k] = min(limit[k], np.sqrt(limit[k + 1] ** 2 + gain))
    for k in range(1, len(limit)):
        limit[k] = min(limit[k], np.sqrt(limit[k - 1] ** 2 + gain))
    share = np.ones(frames)
    if drive.stops:
        start, length = max(4, min(18, frames // 3)), max(4, min(14, frames // 4))
        share = np.interp(np.arange(frames) % 150, [start - 4, start, start + length, start + length + 7],
                          [1, 0, 0, 1])
    driven = np.zeros(frames)
    for k in range(1, frames):
        driven[k] = driven[k - 1] + share[k] * np.interp(driven[k - 1], track.s, limit)
    return driven


def _pose(x, y, z, heading, pitch=0.0, roll=0.0):
    """Camera-to-world, 4x4: turned right by heading, up by pitch, clockwise by roll."""
    ch, sh, cp, sp, cr, sr = (f(a) for a in (heading, pitch, roll) for f in (np.cos, np.sin))
    turn = np.array([[ch, 0, sh], [0, 1, 0], [-sh, 0, ch]])
    nod = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    lean = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ nod @ lean
    pose[:3, 3] = x, y, z
    return pose


def way(name, frames, seed):
    """One sequence's track, its camera-to-world poses in the street's coordinates, and the metres driven."""
    plan = DRIVES[name]
    track = Track(plan.pieces, -BEHIND, frames * plan.pace * 1.15 + AHEAD)
    phase = _rng(seed, 1, int(name)).uniform(0, 2 * np.pi, 6)
    driven = _driven(plan, track, frames, phase[0])
    # The body sways with the way driven, so that a standing car stands still.
    x, z, heading = track.at(driven, plan.lane + 0.06 * np.sin(driven / 6 + phase[1]))
    pitch = np.radians(0.12) * np.sin(driven / 1.9 + phase[2]) + np.radians(0.08) * np.sin(driven / 0.83 + phase[3])
    roll = np.radians(0.12) * np.sin(driven / 2.7 + phase[4])
    y = -CAMERA_HEIGHT + 0.008 * np.sin(driven / 1.3 + phase[5])
    poses = np.array([_pose(*values) for values in zip(x, y, z, heading, pitch, roll)])
    return track, poses, driven


@lru_cache(maxsize=2)
def drive(name, frames, scale, seed):
    """The scene of one sequence."""
    track, poses, driven = way(name, frames, seed)
    size, intrinsics = scaled_camera(name, scale)
    scene = street.build(_rng(seed, 4, int(name)), textures.build(seed), track, DRIVES[name].style)
    return Scene(scene, poses, driven, intrinsics, size)


def relative_to_first(poses):
    """The same poses in the first camera's frame; the first is the identity to the last bit."""
    rotation, position = poses[0, :3, :3], poses[0, :3, 3]
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    for k in range(1, len(poses)):
        # Sums of products in fixed order, so that no linear algebra library rounds them its own way.
        result[k, :3, :3] = (rotation[:, :, None] * poses[k, :3, None, :3]).sum(axis=0)
        result[k, :3, 3] = (rotation * (poses[k, :3, 3] - position)[:, None]).sum(axis=0)
    return result


def _expose(rng, image, level, noise):
    """8-bit picture: automatic exposure (rounded, so that it is the same everywhere), vignette, sensor noise."""
    mean = float(np.mean(image, dtype=np.float64))
    gain = round((level / max(mean, 1.0)) ** 0.8 * (1 + 0.01 * rng.standard_normal()) * 512) / 512
    rows, columns = image.shape
    y = np.linspace(-1, 1, rows, dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, columns, dtype=np.float32)[None]
    picture = image * np.float32(gain) * (1 - np.float32(0.06) * (x * x + y * y))
    # Photon noise grows with the square root of the light.
    sigma = np.float32(noise) * np.sqrt(np.float32(0.25) + np.maximum(picture, 0) / np.float32(160))
    picture = picture + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def render_frame(name, index, frames=60, scale=0.5, seed=0):
    """Frame `index` of a sequence of that many frames: image and label map, both uint8 (height, width)."""
    scene, plan = drive(name, frames, scale, seed), DRIVES[name]
    image, labels = scene.street.view(scene.poses[index], scene.intrinsics, scene.size, index, scene.driven[index])
    return _expose(_rng(seed, 2, int(name), index), image, plan.level, plan.noise), labels


def render_image(split, index, scale=0.5, seed=0):
    """Training or validation image `index` ("train", "val"): image and label map, both uint8 (height, width)."""
    rng = _rng(seed, 3, ("train", "val").index(split), index)
    plan = DRIVES[SEQUENCES[int(rng.integers(0, len(SEQUENCES)))]]
    bend = rng.uniform(-70, 70)
    pieces = ((float(rng.uniform(8, 40)), 0.0), (float(rng.uniform(15, 40)), bend if rng.random() < 0.6 else 0.0),
              (60.0, 0.0))
    sky = (rng.uniform(120, 190), rng.uniform(175, 235), rng.uniform(0.1, 0.9))
    style = Style(**{**plan.style.__dict__, "sunny": bool(rng.random() < 0.65), "leader": 0.0, "crossing": -1.0,
                     "sun": (rng.uniform(-np.pi, np.pi), rng.uniform(0.45, 1.0)), "sky": sky,
                     "persons": rng.uniform(0.05, 0.25), "traffic": rng.uniform(0.01, 0.05),
                     "parked": rng.uniform(0.3, 0.8), "trees": rng.uniform(0.1, 0.9)})
    track = Track(pieces, -BEHIND, AHEAD, repeat=False)
    scene = street.build(rng, textures.build(seed), track, style)
    x, z, heading = track.at(rng.uniform(0, 12), plan.lane * rng.uniform(-0.3, 1.2))
    pose = _pose(x, -rng.uniform(1.2, 1.9), z, heading + np.radians(rng.uniform(-14, 14)),
                 np.radians(rng.uniform(-2.5, 2)), np.radians(rng.uniform(-1, 1)))
    height, width = round(IMAGE_SIZE[0] * scale), round(IMAGE_SIZE[1] * scale)
    focal = width * rng.uniform(0.6, 1.0)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    image, labels = scene.view(pose, intrinsics, (height, width), int(rng.integers(0, 30)))
    picture = _expose(rng, image, rng.uniform(88, 122), rng.uniform(1.2, 3.0))
    if rng.random() < 0.6:
        _bonnet(rng, picture, labels)
    edge = max(1, round(width / 400))  # Cityscapes leaves the outermost pixels out of its region of interest
    for part in (np.s_[:edge], np.s_[-edge:], np.s_[:, :edge], np.s_[:, -edge:]):
        labels[part] = ID["out of roi"]
    return picture, labels


def _bonnet(rng, picture, labels):
    """The own car's bonnet at the lower edge, as in Cityscapes."""
    height, width = picture.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    across = (x - width / 2) / (width / 2)
    top = height * (rng.uniform(0.88, 0.94) + 0.09 * across ** 4)
    inside = y > top
    shine = 150 - 90 * (y - top) / (height - top + 1e-3) + 25 * np.cos(across * 5)
    shine = shine + rng.uniform(-50, 20) + 2 * rng.standard_normal(picture.shape, dtype=np.float32)
    picture[inside] = np.clip(shine, 12, 250).astype(np.uint8)[inside]
    labels[inside] = ID["ego vehicle"]


def _jobs_of(root, sequences, frames, train_images, validation_images):
    """Every picture of the world: (kind, name, index, image path, label path)."""
    for name in sequences:
        folder = root / "kitti" / "sequences" / name
        for index in range(frames):
            picture = f"{index:06d}.png"
            yield "frame", name, index, folder / "image_0" / picture, folder / "labels_0" / picture
    for split, count, cities in (("train", train_images, TRAIN_CITIES), ("val", validation_images, VALIDATION_CITIES)):
        for index in range(count):
            city, number = cities[index % len(cities)], index // len(cities)
            stem = f"{city}_{number:06d}_000000"
            base = root / "cityscapes"
            yield ("image", split, index, base / "leftImg8bit" / split / city / f"{stem}_leftImg8bit.png",
                   base / "gtFine" / split / city / f"{stem}_gtFine_labelIds.png")


def _write_some(some, frames, scale, seed):
    for kind, name, index, image_path, label_path in some:
        image, labels = (render_frame(name, index, frames, scale, seed) if kind == "frame"
                         else render_image(name, index, scale, seed))
        write_png(label_path, labels)
        write_png(image_path, image)
    return len(some)


def _write_sequence_texts(root, name, frames, scale, seed):
    folder = root / "kitti" / "sequences" / name
    _, intrinsics = scaled_camera(name, scale)
    lines = []
    for camera in range(4):
        projection = np.zeros((3, 4))
        projection[:, :3] = intrinsics
        projection[0, 3] = -BASELINE * intrinsics[0, 0] * (camera % 2)
        lines.append(f"P{camera}: " + " ".join(f"{value:.12e}" for value in projection.ravel()))
    write_text(folder / "calib.txt", "\n".join(lines) + "\n")
    write_text(folder / "times.txt", "".join(f"{FRAME_TIME * k:.6e}\n" for k in range(frames)))
    kitti.write_kitti_poses(root / "kitti" / "poses" / f"{name}.txt", relative_to_first(way(name, frames, seed)[1]))


def _check(sequences, frames, scale, train_images, validation_images, seed):
    unknown = [name for name in sequences if name not in DRIVES]
    if unknown or not sequences:
        raise InputError(f"sequences: the embedded world has 00 to 10, not {unknown[0] if unknown else 'none'!r}")
    for name, value, low in (("frames", frames, 2), ("train_images", train_images, 0),
                             ("validation_images", validation_images, 0), ("seed", seed, 0)):
        if value != int(value) or value < low:
            raise InputError(f"{name}: must be a whole number of at least {low}, not {value!r}")
    if not 0.1 <= scale <= 1:
        raise InputError(f"scale: must lie between 0.1 and 1 (KITTI's full size), not {scale!r}")


def write(out, *, sequences=SEQUENCES, frames=60, scale=1.0, train_images=100, validation_images=20, seed=0, jobs=-1,
          replace=False):
    """Write the embedded world to OUT/kitti and OUT/cityscapes; goes on where a stopped run left off.

    sequences: names among 00 to 10; frames: of each; scale: of KITTI's image size (and of 1024x512 for the training
    images); jobs: processes, -1 for one a core. A complete world of the same parameters is left as it is.
    replace: delete an embedded world of other parameters first; nothing else is ever deleted.
    Raises InputError for a folder that holds something else, a world of other parameters, or a bad parameter.
    """
    out, sequences = Path(out), tuple(sequences)
    _check(sequences, frames, scale, train_images, validation_images, seed)
    parameters = {"sequences": list(sequences), "frames": int(frames), "scale": float(scale),
                  "train_images": int(train_images), "validation_images": int(validation_images), "seed": int(seed)}
    stages.stage(out, replace=replace, code=stages.code("world"), **parameters)
    pictures = _jobs_of(out, sequences, frames, train_images, validation_images)
    missing = [picture for picture in pictures if not (picture[3].is_file() and picture[4].is_file())]
    for stale in out.glob("**/.*.png"):  # left by a killed run
        stale.unlink()
    groups = {}
    for picture in missing:
        groups.setdefault((*picture[:2], picture[2] // 10), []).append(picture)
    workers = min(cpu_count() if jobs == -1 else jobs, 1 + len(missing) // 40)
    if workers > 1:
        render.compile_for_all()
    with progress(description="rendering the embedded world", total=len(missing), unit="picture") as bar:
        work = (delayed(_write_some)(group, frames, scale, seed) for group in groups.values())
        for count in Parallel(n_jobs=workers, return_as="generator_unordered")(work):
            bar.update(count)
    for name in sequences:
        if not (out / "kitti" / "poses" / f"{name}.txt").is_file():  # the last of them
            _write_sequence_texts(out, name, frames, scale, seed)
