"""What draws the figures of the thesis, one module a chapter, for the notebooks beside it."""
