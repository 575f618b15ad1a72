"""The constants behind all results, once more: one that is changed here changes results."""

import pytest

from keypoint_study import ratios, verdicts
from thesis_repro.data import cityscapes, memory
from thesis_repro.masks import filter as thesis_filter
from thesis_repro.masks import kinds
from thesis_repro.odometry import estimators, inputs, loop, metrics, settings
from thesis_repro.odometry.refined import fit, motion_prior

CONSTANTS = {
    thesis_filter: {
        "CANNY": (5, 15),
        "WIDTHS": (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15),
    },
    kinds: {
        "CLASS_EDGE_WINDOW": 5,
        # people and vehicles, with what hangs on them
        "MOVABLE": (24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34),
        "DYNASLAM_MARGIN": 15,
        "THESIS_MASKS": kinds.MaskSettings(
            boundaries="canny",
            symmetric=False,
            classes=(),
            movable=None,
            margin=0,
            keep="boundaries",
            canny=(5, 15),
        ),
    },
    loop: {"PROBABILITY": 0.999, "TERMINATION": (3, 30, 0.01), "MIN_MATCHES": 5, "MAX_TURN": 6.0},
    settings: {
        "THESIS": settings.OdometrySettings(
            detector=None,
            estimator=None,
            max_keypoints=2000,
            min_distance=3,
            redetect_below=2000,
            quality=0.01,
            block_size=5,
            window=21,
            levels=3,
            threshold=0.0003,
            shuffle_seed=None,
            scale_gate=0.1,
        ),
        # a setting here shares keypoints with another run
        "AFTER_DETECTION": {
            "redetect_below",
            "window",
            "levels",
            "threshold",
            "shuffle_seed",
            "estimator",
            "scale_gate",
        },
    },
    inputs: {"MIN_CONTRAST": 4.0, "MANY": 20, "WEAKER": 2},
    estimators: {"COMPARED": ("thesis", "refined")},
    memory: {"FRAME_TIME": 0.1},
    metrics: {
        "RELATIVE_LENGTH": 20.0,
        "MIN_DIRECTED_STEP": 0.25,
        "FAILED_ROTATION": 2.0,
        "TURN_RATE": 1.0,
        "STRAIGHT_RATE": 0.3,
        "KITTI_LENGTHS": (100, 200, 300, 400, 500, 600, 700, 800),
        "KITTI_EVERY": 10,
    },
    fit: {
        "MIN_MATCHES": 5,
        "MAX_ITERATIONS": 10,
        "REFINE_ROUNDS": 3,
        "SUPPORT_THRESHOLDS": 2,
        "RESTART_SCALES": (4, 1),
        "SAME_MOTION_COSINE": pytest.approx(0.9659258262890683, rel=1e-15),
        "LOWER_COST": 0.99,
    },
    motion_prior: {
        "MAX_ROTATION_CHANGE": 1.5,
        "MAX_HEADING_CHANGE": 20.0,
        "MAX_FIRST_ROTATION": 5.0,
        "PRIOR_FIT_THRESHOLDS": 4,
        "SAME_SUPPORT": 0.97,
        "MIN_SUPPORT": 0.6,
        "MAX_ROTATION_STD": 0.5,
        "MAX_HEADING_STD": 5.0,
    },
    verdicts: {
        "LEVEL": 95,
        "NARROW_LEVEL": 90,
        "MIN_SEQUENCES": 6,
        "DISAGREEING": 2,
        "TOO_FAR": {"less": 1.5, "more": 1.5, "no clear difference": 1.5, "as much": 1.25},
    },
    ratios: {"MIN_FOR_INTERVAL": 3, "FAR_OFF": 3},
    cityscapes: {"N_CLASSES": 35},
}


@pytest.mark.parametrize("module", CONSTANTS, ids=lambda module: module.__name__)
def test_results_are_made_with_these_constants(module):
    expected = CONSTANTS[module]
    assert {name: getattr(module, name) for name in expected} == expected
