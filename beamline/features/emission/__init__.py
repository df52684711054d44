"""Emission: the counts of a sample that emits, from a scene to views. recon.features.emission has methods for them."""

from __future__ import annotations

SCENES = {"emission": "beamline.features.emission.simulate"}

VIEWS = {"emission": "beamline.features.emission.views"}
