"""cv2.findEssentialMat (RANSAC), recoverPose and calcOpticalFlowPyrLK: the same bits, faster."""

from opencv_exact.lucas_kanade import reason_for_opencv, track
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
    "reason_for_opencv",
    "recover_pose",
    "solve_five_points",
    "track",
]
