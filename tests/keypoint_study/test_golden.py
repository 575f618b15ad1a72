"""A study of the embedded world gives the table of runs in git, on x86 processors with AVX2.

Errors go through BLAS and LAPACK, whose kernels differ between processors in the last digits.
"""

import platform
from io import StringIO
from pathlib import Path

import pandas as pd
import pytest
from street import Street

from keypoint_study import runner
from keypoint_study.jobs import Job, runs_of
from keypoint_study.plan import Study
from keypoint_study.sources import Source
from thesis_repro.data.sequence import Sequence

GOLDEN = Path(__file__).with_name("runs.csv")
pytestmark = pytest.mark.bits


@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="other architectures track otherwise"
)
def test_the_runs_of_a_study_are_those_in_git(small_world, small_labels, tmp_path):
    study = Study(
        small_world / "kitti",
        ("00",),
        (Source(small_labels, name="net"),),
        widths=(10,),
        tested=10,
        estimators=("thesis", "refined"),
    )
    outcome = study.run(tmp_path)
    # a turn of more than 100 metres, from which on KITTI's errors are measured; a camera does not
    # see how long its steps are, so they may be called 10 metres
    street = Street(13, bend=0.008)
    street.poses[:, :3, 3] *= 25
    sequence = Sequence.from_arrays(
        street.images, street.intrinsics, poses=street.poses, name="turn"
    )
    jobs = [Job("turn", "baseline", estimator=name) for name in ("thesis", "refined")]
    turn = runner.run_all(runs_of(jobs, [sequence], [Source(tmp_path)]), tmp_path).table
    table = pd.concat([outcome.table, turn])
    table = pd.read_csv(StringIO(table.to_csv(index=False)), dtype={"sequence": str})
    golden = pd.read_csv(GOLDEN, dtype={"sequence": str})
    # a new error is a column more
    pd.testing.assert_frame_equal(table[golden.columns], golden, rtol=1e-9, atol=1e-12)
    assert golden.notna().any().all()  # each error was measured
    assert (outcome.made, outcome.kept, len(outcome.reasons)) == (len(outcome.table), 0, 0)
