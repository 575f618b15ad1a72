"""OpenCV's RANSAC for the essential matrix: the same bits in less than half the time."""
