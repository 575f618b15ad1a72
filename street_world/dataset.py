"""The embedded world: rendered street drives with exact poses and label maps, written as files.

The files have the two real layouts. OUT/kitti has the layout of the KITTI odometry benchmark, plus
sequences/NN/labels_0 with the exact label maps. OUT/cityscapes has the layout of Cityscapes and
shows other streets than the sequences. Each picture depends only on the seed and its own name, so
neither the number of processes nor an interruption changes a byte.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import cpu_count as cores

from street_world import drives, street, textures
from thesis_repro.data import kitti, trajectories
from thesis_repro.data.arrays import FRAME_TIME
from thesis_repro.running import provenance
from thesis_repro.running.files import progress, write_png, write_text
from thesis_repro.running.workers import open_pool

SEQUENCES = tuple(drives.DRIVES)
BASELINE = 0.537  # metres between KITTI's cameras, for P1 and P3 of the calibration file
# for which one more process pays: it starts in the time of forty pictures
PICTURES_OF_A_WORKER = 150
IMAGE_SIZE = (512, 1024)  # height and width of the training images at scale 1
CITIES = {
    "train": ("birkenstadt", "fuchsheim", "morgental", "silberau", "tannfeld"),
    "val": ("nebelburg", "quellheim"),
}


@lru_cache(maxsize=2)
def _drive(name: str, frames: int, seed: int) -> tuple[street.Street, np.ndarray, np.ndarray]:
    """Return a sequence's street, the camera-to-world poses in it and the metres driven.

    Poses are (frames, 4, 4), metres driven (frames,).
    """
    track, poses, driven = drives.way(name, frames, seed)
    rng = np.random.default_rng((seed, drives.STREET, int(name)))
    scenery = street.build(rng, textures.build(seed), track, drives.DRIVES[name].style)
    return scenery, poses, driven


def render_frame(
    name: str, index: int, frames: int | None = None, scale: float = 0.5, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Render frame `index` of a sequence: image and label map, both uint8 (height, width).

    frames: length of the sequence, on which the street depends; None for the whole drive.
    """
    plan = drives.DRIVES[name]
    scenery, poses, driven = _drive(name, frames or plan.frames, seed)
    size, intrinsics = drives.scaled_camera(name, scale)
    image, labels = scenery.view(poses[index], intrinsics, size, index, driven[index])
    rng = np.random.default_rng((seed, drives.SENSOR, int(name), index))
    return _expose(rng, image, plan.level, plan.noise), labels


def render_image(
    split: str, index: int, scale: float = 0.5, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Render training or validation image `index`: image and label map, uint8 (height, width).

    split: "train" or "val".
    """
    rng = np.random.default_rng((seed, drives.IMAGE, ("train", "val").index(split), index))
    plan = drives.DRIVES[SEQUENCES[int(rng.integers(0, len(SEQUENCES)))]]
    track = _random_track(rng)
    scenery = street.build(rng, textures.build(seed), track, _random_style(rng, plan.style))
    camera = _random_camera(rng, track, plan.lane)
    height, width = round(IMAGE_SIZE[0] * scale), round(IMAGE_SIZE[1] * scale)
    focal = width * rng.uniform(0.6, 1.0)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    image, labels = scenery.view(camera, intrinsics, (height, width), int(rng.integers(0, 30)))
    return _expose(rng, image, rng.uniform(88, 122), rng.uniform(1.2, 3.0)), labels


def _random_track(rng: np.random.Generator) -> drives.Track:
    """Return a road that is straight or has one bend."""
    bend = rng.uniform(-70, 70)
    straight = float(rng.uniform(8, 40))
    bent = float(rng.uniform(15, 40))
    if rng.random() >= 0.6:
        bend = 0.0
    pieces = ((straight, 0.0), (bent, bend), (300.0, 0.0))
    return drives.Track(pieces, -drives.BEHIND, drives.AHEAD)


def _random_style(rng: np.random.Generator, style: drives.Style) -> drives.Style:
    """Return a sequence's style with other light, persons, traffic and trees."""
    sky = (rng.uniform(120, 190), rng.uniform(175, 235))
    return dataclasses.replace(
        style,
        leaders=(),
        crossing=None,
        sky=sky,
        sunny=bool(rng.random() < 0.65),
        sun=(rng.uniform(-np.pi, np.pi), rng.uniform(0.45, 1.0)),
        persons=rng.uniform(0.05, 0.25),
        traffic=rng.uniform(0.01, 0.05),
        trees=rng.uniform(0.1, 0.9),
    )


def _random_camera(rng: np.random.Generator, track: drives.Track, lane: float) -> np.ndarray:
    """Return a camera-to-world pose (4, 4) near the start of a road, on its lane or beside it."""
    s = rng.uniform(0, 12)
    x, z, heading = track.at(s, lane * rng.uniform(-0.3, 1.2))
    height = rng.uniform(1.2, 1.9)
    turned = np.radians(rng.uniform((-14, -2.5, -1), (14, 2, 1)))
    (pose,) = drives.poses_of([(x, -height, z)], [(heading, 0, 0) + turned])
    return pose


def _expose(rng: np.random.Generator, image: np.ndarray, level: float, noise: float) -> np.ndarray:
    """Return an 8-bit picture with automatic exposure, vignette and sensor noise.

    level: mean gray value that the exposure aims at; noise: standard deviation at gray value 120.
    """
    mean = float(np.mean(image, dtype=np.float64))
    # The gain is rounded, so that machines whose sums round differently use the same one.
    wanted = (level / max(mean, 1.0)) ** 0.8 * (1 + 0.01 * rng.standard_normal())
    gain = round(wanted * 512) / 512
    rows, columns = image.shape
    y = np.linspace(-1, 1, rows, dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, columns, dtype=np.float32)[None]
    vignette = 1 - np.float32(0.06) * (x * x + y * y)
    picture = image * np.float32(gain) * vignette
    # Photon noise grows with the square root of the light.
    light = np.maximum(picture, 0) / np.float32(160)
    sigma = np.float32(noise) * np.sqrt(np.float32(0.25) + light)
    picture = picture + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def write(
    out: str | Path,
    *,
    sequences: Sequence[str] = SEQUENCES,
    frames: int | None = None,
    scale: float = 1.0,
    train_images: int = 100,
    validation_images: int = 20,
    seed: int = 0,
    jobs: int = -1,
    replace: bool = False,
    only: str | None = None,
) -> tuple[int, int]:
    """Write the embedded world to OUT/kitti and OUT/cityscapes; resumes a stopped run.

    sequences: names among 00 to 10; frames: frames of each sequence, None for its whole drive (41
    to 132); scale: of KITTI's image size, and of 1024x512 for the training images; jobs: number of
    processes, -1 for one a core.
    replace: move an embedded world of other parameters aside first (see `provenance.stage`). A
    complete world of the same parameters is kept.
    only: "kitti" or "cityscapes", to write one of the two.
    Returns (number of pictures rendered, number of pictures in total).
    Raises InputError for a folder that holds other files or is in use by another run, and for a
    world of other parameters.
    """
    out = Path(out)
    parameters: dict[str, Any] = {
        "sequences": list(sequences),
        "frames": frames,
        "scale": scale,
        "train_images": train_images,
        "validation_images": validation_images,
        "seed": seed,
    }
    with provenance.claimed(out):
        code = provenance.digest_of_code("street_world")
        provenance.stage(out, replace=replace, code=code, **parameters)
        pictures = []
        for picture in _pictures(out, **parameters):
            benchmark = picture.image_path.relative_to(out).parts[0]
            if only in (None, benchmark):
                pictures.append(picture)
        missing = [
            picture
            for picture in pictures
            if not (picture.image_path.is_file() and picture.label_path.is_file())
        ]
        if missing:
            _write_missing(missing, jobs)
        if only != "cityscapes":
            for name in sequences:
                if not (out / "kitti" / "poses" / f"{name}.txt").is_file():  # written last
                    count = frames or drives.DRIVES[name].frames
                    _write_sequence_texts(out, name, count, scale, seed)
    return len(missing), len(pictures)


class Picture(NamedTuple):
    """A picture of a world: the function that renders it, and its two files."""

    render: Callable[[], tuple[np.ndarray, np.ndarray]]
    image_path: Path
    label_path: Path


def _pictures(
    root: Path,
    sequences: Sequence[str],
    frames: int | None,
    scale: float,
    train_images: int,
    validation_images: int,
    seed: int,
) -> Iterator[Picture]:
    """Yield every picture of a world."""
    for name in sequences:
        folder = root / "kitti" / "sequences" / name
        for index in range(frames or drives.DRIVES[name].frames):
            render = partial(render_frame, name, index, frames, scale, seed)
            file = f"{index:06d}.png"
            yield Picture(render, folder / "image_0" / file, folder / kitti.TRUE_LABELS / file)
    folder = root / "cityscapes"
    for split, count in (("train", train_images), ("val", validation_images)):
        cities = CITIES[split]
        for index in range(count):
            render = partial(render_image, split, index, scale, seed)
            city, number = cities[index % len(cities)], index // len(cities)
            stem = f"{city}_{number:06d}_000000"
            yield Picture(
                render,
                folder / "leftImg8bit" / split / city / f"{stem}_leftImg8bit.png",
                folder / "gtFine" / split / city / f"{stem}_gtFine_labelIds.png",
            )


def _write_missing(missing: list[Picture], jobs: int) -> None:
    """Render and write pictures in several processes."""
    workers = min(cores() if jobs < 0 else jobs, 1 + len(missing) // PICTURES_OF_A_WORKER)
    first = "starting the renderer (its first use compiles it, up to a minute)"
    with progress(description=first, total=len(missing), unit="picture") as bar:
        bar.refresh()  # shown before the first picture is done
        # compiles the rasteriser once, for all worker processes
        bar.update(_write_pictures(missing[:1]))
        bar.set_description("rendering the embedded world", refresh=False)
        # Ten at a time, because pictures of one sequence share its street.
        calls = [(missing[start : start + 10],) for start in range(1, len(missing), 10)]
        with open_pool(workers) as pool:
            for count in pool.run(_write_pictures, calls):
                bar.update(count)


def _write_pictures(pictures: list[Picture]) -> int:
    """Render and write pictures, and return how many."""
    for picture in pictures:
        image, labels = picture.render()
        write_png(picture.label_path, labels)
        write_png(picture.image_path, image)
    return len(pictures)


def _write_sequence_texts(root: Path, name: str, frames: int, scale: float, seed: int) -> None:
    """Write calib.txt, times.txt and the ground-truth poses of one sequence."""
    folder = root / "kitti" / "sequences" / name
    _, intrinsics = drives.scaled_camera(name, scale)
    lines = []
    for camera in range(4):
        shift = -BASELINE * intrinsics[0, 0] * (camera % 2)
        projection = np.c_[intrinsics, [shift, 0, 0]]
        numbers = " ".join(f"{value:.12e}" for value in projection.ravel())
        lines.append(f"P{camera}: {numbers}\n")
    write_text(folder / "calib.txt", "".join(lines))
    times = [f"{FRAME_TIME * k:.6e}\n" for k in range(frames)]
    write_text(folder / "times.txt", "".join(times))
    _, poses, _ = drives.way(name, frames, seed)
    path = root / "kitti" / "poses" / f"{name}.txt"
    trajectories.write_kitti_poses(path, drives.relative_to_first(poses))
