"""Counts of a sample that emits, with what their mean holds."""

from __future__ import annotations

FORMATS = {"emission": "beamline.storage.readers.emission.counts"}
