"""python -m thesis_repro: the command line."""

from thesis_repro.command.cli import main

raise SystemExit(main())
