"""Monocular visual odometry as PySLAM does it (Section 3.7): Shi-Tomasi, Lucas-Kanade, essential matrix, pose.

`run(sequence)` runs it once. `run_many` makes many runs over one sequence for little more than the cost of their
estimators. THESIS agrees with PySLAM of August 2021 on every frame. Frames on which PySLAM crashes follow a rule here,
and doubtful frames get a flag:

| frame                                       | flag and rule (the pose is kept, but for "no keypoints")             |
|---------------------------------------------|----------------------------------------------------------------------|
| black, blown out, no contrast               | "flat frame": skipped; the next motion is measured from the last     |
|                                             | frame before it, over the sum of their scales                        |
| no new keypoint (an all-zero mask, say)     | "no keypoints": the tracked points are tracked further               |
| no point to track                           | "no points": starts again from this frame's keypoints                |
| too few correspondences for a motion        | "fewer than five correspondences"                                    |
| none or several essential matrices          | "no essential matrix", "several essential matrices"                  |
| agreement no better than chance (scene cut) | "no agreement"                                                       |
| moved less than the gate (PySLAM's rule)    | "stationary"                                                         |
| the same picture, though the poses moved    | "still picture": moves on as PySLAM does                             |
| turns by more than a car can                | "too large a turn": the same                                         |

With settings.fallback and masks, the flag "all keypoints used" says that the masked keypoints do not determine the
motion, or that it differs too much from the previous step's. With estimator="refined" there are two more flags, and the
pose is always moved (see refined.motion_prior):

| motion                                        | flag and rule                                                      |
|-----------------------------------------------|--------------------------------------------------------------------|
| not consistent with the step before           | "ambiguous motion": the best consistent motion, if nearly as many  |
|                                               | points are near it; if not, the estimated one                      |
| not determined by its points (all on a line)  | the same, or "motion not determined" where that is not determined  |
|                                               | either: the motion of the step before, over this step's length     |
"""

from thesis_repro.odometry.odometry import Odometry, Step
from thesis_repro.odometry.passes import Result, run, run_many, scales, start_pose
from thesis_repro.odometry.settings import PRESETS, PYSLAM_2024, THESIS, OdometrySettings

__all__ = ["PRESETS", "PYSLAM_2024", "THESIS", "Odometry", "OdometrySettings", "Result", "Step", "run", "run_many",
           "scales", "start_pose"]
