"""Check the worth of a keypoint against the truth, in the embedded world: `make worth-check`.

The drives are those of the demo profile, their label maps by the model in the package, as on real
streets. All steps count. It writes keypoint_study/worth_check.csv, by which the tables of worths
judge, figures/worth_check.md, and the evidence's tables of worths, judged anew.
"""

import pandas as pd
from joblib import cpu_count

import evidence
import street_world
from keypoint_study import worth, worth_check
from keypoint_study.methods import METHODS, Asked
from keypoint_study.sources import Source
from thesis.settings import ROOT
from thesis_repro.data import kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.running import program, workers
from thesis_repro.running.files import progress, write_text
from thesis_repro.segmentation import prediction

# {number of keypoints: choices}, of which tables and texts say a word
CHECKED = {
    100: ("masked", "spread-anywhere"),
    200: ("masked", "spread-anywhere", "strongest", "mirrored"),
    400: (
        "masked",
        "spread-anywhere",
        "strongest",
        "mirrored",
        "exact-boundaries",
        "mirrored-exact",
    ),
}
DRAWS = 24  # of keypoints whose motion is compared with the exact one


def of_drive(sequence: Sequence, source: Source) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the worths of a drive, and the true ones."""
    chosen = {
        (METHODS[name].title, number): METHODS[name].choose(Asked(sequence, source, number=number))
        for number, names in CHECKED.items()
        for name in names
    }
    estimated = worth.worth_of(sequence, chosen)
    return estimated, worth_check.true_worths(sequence, chosen, DRAWS)


def main() -> None:
    """Render the drives, predict label maps, and write both tables."""
    folder = ROOT / "build" / "worth_check"
    world = folder / "world"
    cores = cpu_count()
    street_world.write(
        world, **street_world.SIZES["demo"], seed=0, jobs=cores, only="kitti", replace=True
    )
    names = kitti.sequences(world / "kitti")
    sequences = [Sequence(world / "kitti", name) for name in names]
    model = prediction.load_shipped()
    for sequence in sequences:
        labels = folder / "labels" / sequence.name
        prediction.write_label_maps(model, sequence.frame_paths, labels)
    calls = [(sequence, Source(folder / "labels")) for sequence in sequences]
    with workers.open_pool(cores) as pool:
        made = progress(pool.run(of_drive, calls), "worth", total=len(calls), unit="drive")
        tables = list(made)
    estimated, true = (pd.concat(each) for each in zip(*tables, strict=True))
    table = worth_check.table_of_checks(estimated, true)
    text = table.to_csv(index=False, lineterminator="\n", float_format="%.4g")
    write_text(worth_check.TABLE, text)
    worth_check.checks.cache_clear()
    note = (evidence.FOLDER / "worth.md").read_text(encoding="utf-8").splitlines()[-1]
    evidence.judge(evidence.FOLDER, note)


if __name__ == "__main__":
    program.run_main(main)
