"""Corrections of projections. Each correction has its own file and a line in `registry`."""
