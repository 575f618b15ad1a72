"""The embedded world: rendered street drives with exact poses and label maps, written in the two real file layouts.

OUT/kitti is laid out as the KITTI odometry benchmark (plus sequences/NN/labels_0, the exact label map of every frame),
OUT/cityscapes as Cityscapes; its images show other streets than the sequences. Each picture depends on the seed and
its own name alone, so that neither the number of processes nor an interruption changes a byte.
"""

import dataclasses
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs

from thesis_repro import InputError, kitti, longrun, stages
from thesis_repro.files import is_whole, progress, write_png, write_text
from thesis_repro.world import drives, street, textures
from thesis_repro.world.raster import compile_for_all

SEQUENCES = tuple(drives.DRIVES)
BASELINE = 0.537  # metres between KITTI's cameras, for the calibration file's P1 and P3
IMAGE_SIZE = (512, 1024)  # of the training images at scale 1
CITIES = {"train": ("birkenstadt", "fuchsheim", "morgental", "silberau", "tannfeld"),
          "val": ("nebelburg", "quellheim")}


@dataclasses.dataclass
class Scene:
    """A street with the camera's way along it: scene poses, and the way driven (metres) at each frame."""

    street: street.Street
    poses: np.ndarray
    driven: np.ndarray
    intrinsics: np.ndarray
    size: tuple


@lru_cache(maxsize=2)
def drive(name, frames, scale, seed):
    """The `Scene` of one sequence."""
    track, poses, driven = drives.way(name, frames, seed)
    size, intrinsics = drives.scaled_camera(name, scale)
    rng = drives.generator(seed, drives.STREET, int(name))
    crossing = drives.crossing(track, drives.DRIVES[name].style)
    scenery = street.build(rng, textures.build(seed), track, drives.DRIVES[name].style, crossing)
    return Scene(scenery, poses, driven, intrinsics, size)


def render_frame(name, index, frames=None, scale=0.5, seed=0):
    """Frame `index` of a sequence of that many frames: image and label map, both uint8 (height, width).

    frames: None for the drive's own number.
    """
    scene, plan = drive(name, frames or drives.DRIVES[name].frames, scale, seed), drives.DRIVES[name]
    image, labels = scene.street.view(scene.poses[index], scene.intrinsics, scene.size, index, scene.driven[index])
    return _expose(drives.generator(seed, drives.SENSOR, int(name), index), image, plan.level, plan.noise), labels


def render_image(split, index, scale=0.5, seed=0):
    """Training or validation image `index` ("train", "val"): image and label map, both uint8 (height, width)."""
    rng = drives.generator(seed, drives.IMAGE, ("train", "val").index(split), index)
    plan = drives.DRIVES[SEQUENCES[int(rng.integers(0, len(SEQUENCES)))]]
    bend = rng.uniform(-70, 70)
    pieces = ((float(rng.uniform(8, 40)), 0.0), (float(rng.uniform(15, 40)), bend if rng.random() < 0.6 else 0.0),
              (300.0, 0.0))
    sky = (rng.uniform(120, 190), rng.uniform(175, 235))
    style = dataclasses.replace(
        plan.style, leaders=(), crossing=None, sky=sky, sunny=bool(rng.random() < 0.65),
        sun=(rng.uniform(-np.pi, np.pi), rng.uniform(0.45, 1.0)), persons=rng.uniform(0.05, 0.25),
        traffic=rng.uniform(0.01, 0.05), trees=rng.uniform(0.1, 0.9))
    track = drives.Track(pieces, -drives.BEHIND, drives.AHEAD)
    scenery = street.build(rng, textures.build(seed), track, style)
    x, z, heading = track.at(rng.uniform(0, 12), plan.lane * rng.uniform(-0.3, 1.2))
    camera = drives.poses_of([(x, -rng.uniform(1.2, 1.9), z)],
                             [(heading, 0, 0) + np.radians(rng.uniform((-14, -2.5, -1), (14, 2, 1)))])[0]
    height, width = round(IMAGE_SIZE[0] * scale), round(IMAGE_SIZE[1] * scale)
    focal = width * rng.uniform(0.6, 1.0)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    image, labels = scenery.view(camera, intrinsics, (height, width), int(rng.integers(0, 30)))
    return _expose(rng, image, rng.uniform(88, 122), rng.uniform(1.2, 3.0)), labels


def _expose(rng, image, level, noise):
    """8-bit picture: automatic exposure (rounded, so that it is the same everywhere), vignette, sensor noise.

    level: the mean gray that the exposure aims at; noise: its deviation at gray 120.
    """
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


def write(out, *, sequences=SEQUENCES, frames=None, scale=1.0, train_images=100, validation_images=20, seed=0, jobs=-1,
          replace=False, only=None):
    """Write the embedded world to OUT/kitti and OUT/cityscapes; goes on where a stopped run left off.

    sequences: names among 00 to 10; frames: of each, None for as many as show its whole drive, from 41 to 132; scale:
    of KITTI's image size (and of 1024x512 for the training images); jobs: processes, -1 for one a core. A complete
    world of the same parameters is left as it is.
    replace: delete an embedded world of other parameters first; nothing else is ever deleted.
    only: "kitti" or "cityscapes", to write one of the two now.
    Returns how many pictures were rendered, and how many there are.
    Raises InputError for a folder that holds something else or that another run is at work in, a world of other
    parameters, or a bad parameter.
    """
    out = Path(out)
    parameters = _parameters(sequences, frames, scale, train_images, validation_images, seed)
    with longrun.claimed(out):
        stages.stage(out, replace=replace, code=stages.code("world"), **parameters)
        pictures = [picture for picture in _pictures(out, **parameters)
                    if only in (None, picture[1].relative_to(out).parts[0])]
        missing = [picture for picture in pictures if not all(map(is_whole, picture[1:]))]
        workers = min(effective_n_jobs(jobs), 1 + len(missing) // 40)
        if workers > 1:
            compile_for_all()
        with progress(description="rendering the embedded world", total=len(missing), unit="picture") as bar:
            # Ten at a time: pictures of one sequence share its street.
            work = (delayed(_write_some)(missing[k:k + 10]) for k in range(0, len(missing), 10))
            for count in Parallel(n_jobs=workers, return_as="generator_unordered",
                                  initializer=longrun.end_with_parent)(work):
                bar.update(count)
        for name in parameters["sequences"] if only != "cityscapes" else ():
            if not (out / "kitti" / "poses" / f"{name}.txt").is_file():  # the last of them
                _write_sequence_texts(out, name, parameters["frames"] or drives.DRIVES[name].frames, scale, seed)
    return len(missing), len(pictures)


def _parameters(sequences, frames, scale, train_images, validation_images, seed):
    """What a world is made from, checked. Raises InputError for a value that names no world."""
    unknown = [name for name in sequences if name not in drives.DRIVES]
    if unknown or not sequences:
        raise InputError(f"sequences: the embedded world has 00 to 10, not {unknown[0] if unknown else 'none'!r}")
    for name, value, low in (("frames", 2 if frames is None else frames, 2), ("train_images", train_images, 0),
                             ("validation_images", validation_images, 0), ("seed", seed, 0)):
        if value != int(value) or value < low:
            raise InputError(f"{name}: must be a whole number of at least {low}, not {value!r}")
    if not 0.1 <= scale <= 1:
        raise InputError(f"scale: must lie between 0.1 and 1 (KITTI's full size), not {scale!r}")
    return {"sequences": list(sequences), "frames": None if frames is None else int(frames), "scale": float(scale),
            "train_images": int(train_images), "validation_images": int(validation_images), "seed": int(seed)}


def _pictures(root, sequences, frames, scale, train_images, validation_images, seed):
    """Every picture of a world: (function that renders it, image path, label path)."""
    for name in sequences:
        folder = root / "kitti" / "sequences" / name
        for index in range(frames or drives.DRIVES[name].frames):
            picture = f"{index:06d}.png"
            yield (partial(render_frame, name, index, frames, scale, seed),
                   folder / "image_0" / picture, folder / "labels_0" / picture)
    for split, count in (("train", train_images), ("val", validation_images)):
        for index in range(count):
            city, number = CITIES[split][index % len(CITIES[split])], index // len(CITIES[split])
            stem = f"{city}_{number:06d}_000000"
            yield (partial(render_image, split, index, scale, seed),
                   root / "cityscapes" / "leftImg8bit" / split / city / f"{stem}_leftImg8bit.png",
                   root / "cityscapes" / "gtFine" / split / city / f"{stem}_gtFine_labelIds.png")


def _write_some(pictures):
    for render, image_path, label_path in pictures:
        image, labels = render()
        write_png(label_path, labels)
        write_png(image_path, image)
    return len(pictures)


def _write_sequence_texts(root, name, frames, scale, seed):
    """calib.txt, times.txt and the true poses of one sequence."""
    folder = root / "kitti" / "sequences" / name
    _, intrinsics = drives.scaled_camera(name, scale)
    lines = []
    for camera in range(4):
        projection = np.c_[intrinsics, [-BASELINE * intrinsics[0, 0] * (camera % 2), 0, 0]]
        lines.append(f"P{camera}: " + " ".join(f"{value:.12e}" for value in projection.ravel()))
    write_text(folder / "calib.txt", "\n".join(lines) + "\n")
    write_text(folder / "times.txt", "".join(f"{kitti.FRAME_TIME * k:.6e}\n" for k in range(frames)))
    _, poses, _ = drives.way(name, frames, seed)
    kitti.write_kitti_poses(root / "kitti" / "poses" / f"{name}.txt", drives.relative_to_first(poses))
