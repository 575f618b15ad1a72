"""OpenCV's essential-matrix estimator repeated to the bit, in less than half of its time."""
