"""A path for tests of errors and trajectories."""

import numpy as np
from scipy.spatial.transform import Rotation


def winding(count=160, seed=None, stretch=1.0):
    """Poses of a path with rotations about all axes and steps of one metre; with a seed, steps
    have noise.
    """
    random, noise = np.random.RandomState(seed), seed is not None
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        turn = np.array([0.01 * np.sin(index), 0.03, 0.02 * np.cos(index)]) + noise * random.normal(
            0, 0.01, 3
        )
        poses[index] = poses[index - 1]
        poses[index, :3, :3] = poses[index - 1, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        poses[index, :3, 3] += stretch * poses[index, :3, 2] + noise * random.normal(0, 0.05, 3)
    return poses
