"""`python -m street_world` renders the drives of the current settings, as notebook 5 does."""

import street_world
from thesis_repro.running import messages
from thesis_repro.running.settings import read_settings


def main() -> None:
    """Render the drives of the current settings."""
    settings = read_settings()
    street_world.write(
        settings.world,
        **settings.sizes.world,
        seed=settings.seed,
        jobs=settings.jobs,
        only="kitti",
        replace=not settings.cityscapes_is_embedded,
    )


if __name__ == "__main__":
    messages.run_main(main)
