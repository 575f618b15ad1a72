"""Monocular visual odometry as PySLAM does it (Section 3.7): Shi-Tomasi, Lucas-Kanade, essential matrix, pose.

`run(sequence)` is the plain way in; `run_many` makes many runs over one sequence for little more than the cost of
their estimators. THESIS agrees with PySLAM of August 2021 on every frame. What PySLAM crashes on has a rule here:

| frame                                       | flag and rule (the pose is kept, but for the second)                 |
|---------------------------------------------|----------------------------------------------------------------------|
| black, blown out, no contrast               | "flat frame": skipped; the next frame is measured from the last good |
|                                             | one, over the sum of their scales                                    |
| no keypoint found (an all-zero mask, say)   | "no keypoints": the tracked points are tracked on                    |
| no point to track                           | "no points": starts again from this frame's keypoints                |
| too few correspondences for a motion        | "fewer than five correspondences"                                    |
| none or several essential matrices          | "no essential matrix", "several essential matrices"                  |
| agreement no better than chance (scene cut) | "no agreement"                                                       |
| moved less than the gate (PySLAM's rule)    | "stationary"                                                         |

With estimator="refined" two more, in which the pose moves on (see continuity):

| motion                                      | flag and rule                                                        |
|---------------------------------------------|----------------------------------------------------------------------|
| unlike the step before                      | "ambiguous motion": the best of those that go on from the step       |
|                                             | before, if nearly as many points are near it; if not, as estimated   |
| left open by its points (on one line, say)  | the same, or "motion not determined" where that is left open too:    |
|                                             | the motion before again, over this step's length                     |
"""

from thesis_repro.odometry.odometry import Odometry, Step
from thesis_repro.odometry.passes import Result, run, run_many, scales, start_pose
from thesis_repro.odometry.settings import PRESETS, PYSLAM_2024, THESIS, OdometrySettings

__all__ = ["PRESETS", "PYSLAM_2024", "THESIS", "Odometry", "OdometrySettings", "Result", "Step", "run", "run_many",
           "scales", "start_pose"]
