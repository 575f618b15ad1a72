"""The fit of notebook 4 on a few made-up images, as a command: python small_training.py FOLDER EPOCHS."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "segmentation"))

from thesis_repro import longrun, stages
from thesis_repro.segmentation import quietly

with quietly():
    from thesis_repro.segmentation import training  # isort: split

    import test_training  # after what sets the libraries' variables

if __name__ == "__main__":
    try:
        folder = stages.stage(sys.argv[1], **training.made_from(*test_training.prepared()))
        test_training.train(folder, int(sys.argv[2]))
    except Exception as error:
        sys.exit(longrun.report_error(error))
