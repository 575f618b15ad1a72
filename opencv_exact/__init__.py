"""cv2.findEssentialMat (RANSAC) and cv2.recoverPose: the same bits, several times faster."""

from opencv_exact.pose import recover_pose
from opencv_exact.ransac import MAX_SAMPLES, draw_samples, find_essential_matrix, is_compiled
from opencv_exact.solver import WELL_CONDITIONED, Solutions, solve_five_points

__all__ = [
    "MAX_SAMPLES",
    "WELL_CONDITIONED",
    "Solutions",
    "draw_samples",
    "find_essential_matrix",
    "is_compiled",
    "recover_pose",
    "solve_five_points",
]
