"""Simulated devices of splatline, and the physics of the frames that they deliver."""

import recon.base.geometry  # noqa: F401 - importing recon says what processor numba compiles for
