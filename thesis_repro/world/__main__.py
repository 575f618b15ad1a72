"""`python -m thesis_repro.world`: the embedded drives of the settings in force, as notebook 5 asks for them."""

import sys

from thesis_repro import InputError, longrun, world
from thesis_repro.settings import read_settings

if __name__ == "__main__":
    try:
        settings = read_settings()
        world.write(settings.world, **settings.sizes.world, seed=settings.seed, jobs=settings.jobs, only="kitti",
                    replace=not settings.cityscapes_is_embedded)
    except (InputError, OSError) as error:
        sys.exit(longrun.report_error(error))
