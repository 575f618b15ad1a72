"""Render the sequences of the embedded world, as notebook 5 does, and compile the shared odometry.

The Makefile runs it while notebook 4 trains the network, to save time.
"""

import street_world
import thesis_repro as tr
from thesis.run_settings import read_settings
from thesis_repro.running import program


def main() -> None:
    """Render sequences as the settings say, and run three frames of one with an estimator."""
    settings = read_settings()
    street_world.write(
        settings.world,
        **settings.sizes.world,
        seed=settings.seed,
        jobs=1,  # training has the other core
        only="kitti",
        replace=not settings.cityscapes_is_embedded,
    )
    refined = tr.OdometrySettings(estimator=tr.refined)
    tr.run_many(tr.Sequence(settings.kitti, "00").subset(3), {"": (refined, None)})


if __name__ == "__main__":
    program.run_main(main)
