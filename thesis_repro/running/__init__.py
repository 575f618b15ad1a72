"""What every run needs: settings, whole files, folders of results, messages."""
