"""The segmentation (appendix A.3 to A.7): augmentation, the U-Net, its training, label maps and their quality."""

import os

# TensorFlow splits an operation among its threads, and sums of pieces round differently for another number of pieces.
# With a number of its own instead of the machine's, any number of cores gives the same bits. It is read once, when the
# first operation runs. More threads than cores cost little; fewer would leave cores of large machines idle.
os.environ.setdefault("TF_NUM_INTRAOP_THREADS", "8")
