"""cv2.findEssentialMat (RANSAC) and cv2.recoverPose: the same bits, several times faster."""

from opencv_exact.pose import recover_pose
from opencv_exact.ransac import find_essential_matrix

__all__ = ["find_essential_matrix", "recover_pose"]
