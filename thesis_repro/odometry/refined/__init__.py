"""The refined estimator (not in the thesis).

The motion is fitted to all points near it and compared with the motion of the step before.
"""

from thesis_repro.odometry.refined.estimator import RefinedEstimator

__all__ = ["RefinedEstimator"]
