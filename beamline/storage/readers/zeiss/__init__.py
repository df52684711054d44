"""Scans of Zeiss instruments."""

from __future__ import annotations

FORMATS = {"txrm": "beamline.storage.readers.zeiss.txrm"}
