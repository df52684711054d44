"""Effects: deviations from Beer-Lambert, by physical kind; a scene computes only the effects that it names."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Domain(IntEnum):
    """The quantity on which an effect acts, in the order of physics."""

    MOTION = 0
    OPTICAL_DEPTH = 1
    PHOTONS = 2
    ELECTRONS = 3
    COUNTS = 4

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class EffectRow:
    """An effect of the catalogue.

    Attributes:
        domain: the quantity on which the effect acts. summary: half a sentence that says what happens. follows: effects
            of the same domain that must come before this one, because another order changes the frame. reason: the
            reason why they come before. module: the module of its class; the class PhotonNoise belongs to the effect
            photon_noise.
    """

    domain: Domain
    summary: str
    follows: frozenset[str] = frozenset()
    reason: str = ""
    module: str = ""
