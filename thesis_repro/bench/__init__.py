"""What the odometry and the segmentation cost on this machine; for development."""
