"""What odometry and segmentation cost on this machine, and how reliable the refined pose is; for development."""
