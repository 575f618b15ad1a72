"""Monocular visual odometry as PySLAM does it (Section 3.7).

A step finds Shi-Tomasi keypoints, tracks them by Lucas-Kanade, and estimates the essential matrix
and from it the pose.

`run(sequence)` runs it once. `run_many` runs it with many settings or masks and shares work between
the runs. With the settings THESIS, motions equal those of PySLAM of August 2021 on the real frames
on which both were run (tests/reference).
On some frames PySLAM crashes; here a rule says what happens. Doubtful frames get a flag. "Kept"
means that the pose does not change:

- black, overexposed or without contrast: "flat frame", skipped. The next motion is measured from
  the last frame before it, over the sum of the step lengths
- equal to the frame before, as in a video at twice its rate: "equal frame", skipped likewise
- no new keypoint (mask all zero, say): "no keypoints", the tracked points are tracked further
- no point to track: "no points", kept; starts again from this frame's keypoints
- too few correspondences: "fewer than five correspondences", kept
- no essential matrix, or several: "no essential matrix", "several essential matrices", kept
- inliers no more than by chance (scene cut): "no agreement", kept
- no match in front of both cameras and nearer than 50 step lengths, for any of the four motions:
  "no votes", moved by the first of them, as in PySLAM (which one is first depends on the processor)
- step shorter than the gate (PySLAM's rule): "stationary", kept
- rotation larger than a car's: "too large a turn", the pose moves, as in PySLAM

With the refined estimator there are two more flags, and the pose is always moved (see
refined.motion_prior):

- motion inconsistent with the previous step: "ambiguous motion", the best consistent motion if
  nearly as many points are near it, otherwise the estimated motion
- motion not determined (all points on a line): "ambiguous motion" if a consistent motion is found,
  otherwise "motion not determined": the previous motion, with this step's length
"""

from thesis_repro.odometry.loop import OPENCV, Calls, Odometry
from thesis_repro.odometry.runs import Masks, Result, run, run_many, start_pose
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.odometry.step import Matches, Motion, Step

__all__ = [
    "OPENCV",
    "THESIS",
    "Calls",
    "Masks",
    "Matches",
    "Motion",
    "Odometry",
    "OdometrySettings",
    "Result",
    "Step",
    "run",
    "run_many",
    "start_pose",
]
