"""The small scans of the tests of the storage."""

from tests.beamline.storage.conftest import clock, frames, write

__all__ = ["clock", "frames", "write"]
