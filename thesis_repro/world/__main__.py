"""`python -m thesis_repro.world` renders the drives of the current settings, as notebook 5 does."""

import sys

from thesis_repro import InputError, console, world
from thesis_repro.settings import read_settings

if __name__ == "__main__":
    try:
        settings = read_settings()
        world.write(
            settings.world,
            **settings.sizes.world,
            seed=settings.seed,
            jobs=settings.jobs,
            only="kitti",
            replace=not settings.cityscapes_is_embedded,
        )
    except (InputError, OSError) as error:
        sys.exit(console.report_error(error))
