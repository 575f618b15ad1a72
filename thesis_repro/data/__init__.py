"""The data: KITTI sequences, raw drives, files of poses, and pairs of images and label maps."""
