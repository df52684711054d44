"""Domain: the quantity that an effect acts on, in the order of physics."""

from __future__ import annotations

from enum import IntEnum


class Domain(IntEnum):
    MOTION = 0
    OPTICAL_DEPTH = 1
    PHOTONS = 2
    ELECTRONS = 3
    COUNTS = 4

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")
