"""The refined estimator (not in the thesis).

The motion is fitted to all points near it and checked with a prior.
"""
