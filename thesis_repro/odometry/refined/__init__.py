"""The refined estimator, which is this project's own: a fit to all points near the motion, and a motion prior."""
