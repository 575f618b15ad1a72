"""The experiments of chapter 4: what is run, running it anywhere, and what it amounts to."""
