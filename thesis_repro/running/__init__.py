"""What every run needs: settings, whole files, the provenance of results, how a program ends."""
