"""OpenCV's essential-matrix estimator repeated to the bit, in a third of its time."""
