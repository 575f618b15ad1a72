"""Checks of the data: what is missing or damaged, and what is readable but odd."""
