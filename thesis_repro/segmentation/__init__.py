"""The segmentation (appendix A.3 to A.7): augmentation, the U-Net, its training, label maps and their quality."""
