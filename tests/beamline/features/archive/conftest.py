"""Small scans to archive."""

from tests.beamline.storage.conftest import clock, frames, write

__all__ = ["clock", "frames", "write"]
