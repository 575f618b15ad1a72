from thesis_repro.cli import main

raise SystemExit(main())
