from thesis_repro.command.cli import main

raise SystemExit(main())
