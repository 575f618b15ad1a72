"""`python -m thesis_repro.world` renders the drives of the current settings, as notebook 5 does."""

from thesis_repro import console, world
from thesis_repro.settings import read_settings


def main() -> None:
    settings = read_settings()
    world.write(
        settings.world,
        **settings.sizes.world,
        seed=settings.seed,
        jobs=settings.jobs,
        only="kitti",
        replace=not settings.cityscapes_is_embedded,
    )


if __name__ == "__main__":
    console.run_main(main)
