"""A street of noise for tests of the odometry.

It is rendered with exact arithmetic, the same on every machine.
"""

import cv2
import numpy as np

from thesis_repro.data.arrays import distances


class Street:
    """A sequence, as far as `odometry.run` needs one.

    It is a drive between two walls along z with a slight turn, 0.4 metres a step. bend: radians,
    half of what each step turns more; the camera drives where it looks.
    """

    name = "street"
    has_truth = True
    size = 160, 480

    def __init__(self, count=10, start=0.0, bend=0.0):
        height, width = self.size
        texture = np.random.RandomState(0).randint(0, 256, (512, 512)).astype(np.uint8)
        texture = cv2.resize(texture, (2048, 2048), interpolation=cv2.INTER_LINEAR)
        camera = np.array([[300.0, 0, (width - 1) / 2], [0, 300.0, (height - 1) / 2], [0, 0, 1]])
        v, u = np.mgrid[:height, :width].astype(np.float64)
        rays = np.stack(
            [(u - camera[0, 2]) / 300, (v - camera[1, 2]) / 300, np.ones_like(u)], axis=-1
        )
        self.images, self.intrinsics, self.poses = [], camera, np.tile(np.eye(4), (count, 1, 1))
        for index, pose in enumerate(self.poses):
            # rotation about y without sines, which machines may round differently
            half = (0.002 + bend) * index
            cosine, sine = (1 - half * half) / (1 + half * half), 2 * half / (1 + half * half)
            pose[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
            pose[:3, 3] = 0.1 * 0.4 * index + 0.4 * bend * index**2, 0, start + 0.4 * index
            x = cosine * rays[..., 0] + sine * rays[..., 2]
            y = rays[..., 1]
            z = -sine * rays[..., 0] + cosine * rays[..., 2]
            centre = pose[:3, 3]
            with np.errstate(divide="ignore"):
                walls = np.where(x > 0, (4 - centre[0]) / x, (-4 - centre[0]) / x)
                floor = np.where(y > 0, 1.6 / y, -5.0 / y)
            depth = np.minimum(walls, np.minimum(floor, 200.0))
            along = centre[2] + depth * z
            across = np.where(walls < floor, depth * y, centre[0] + depth * x + 11.0)
            image = cv2.remap(
                texture,
                ((along * 40) % 2040).astype(np.float32),
                ((across * 40) % 2040).astype(np.float32),
                cv2.INTER_LINEAR,
            )
            self.images.append((128 + (image - 128.0) / (1 + depth / 20)).astype(np.uint8))

    @property
    def scales(self):
        return distances(self.poses)

    def __len__(self):
        return len(self.images)

    def frame(self, index):
        return self.images[index]

    def visible(self, index):
        return None


class Stripes:
    """Masks that keep vertical stripes of a width in pixels, 5 pixels further with every frame."""

    def __init__(self, width):
        self.width = width

    def __getitem__(self, index):
        height, width = Street.size
        columns = (np.arange(width) + 5 * index) // self.width % 2 == 0
        return np.repeat(columns[None] * np.uint8(255), height, axis=0)
