"""Chain: the order of effects from the moving sample to the counts, checked once when a scene is made."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from simulators.phantom import Detector

Image = NDArray[np.float64]


class Domain(IntEnum):
    """What an effect acts on, in the order of physics."""

    MOTION = 0
    OPTICAL_DEPTH = 1
    PHOTONS = 2
    ELECTRONS = 3
    COUNTS = 4


@dataclass(frozen=True, eq=False)
class Shot:
    """The circumstances of one exposure.

    Attributes:
        detector: where the frame's pixels are (after ROI and binning).
        exposure: s.
        time: s since the Unix epoch, at the trigger.
        angle: true angle of the sample at the trigger, radians.
        elapsed: s since the camera was connected; what drifts runs on it.
        row_period: s by which each row starts later than the one above.
        roi: (row0, col0, rows, cols) of the sensor.
        binning: sensor pixels summed per side.
        read_noise: electrons rms a sensor pixel.
        rng: this exposure's own generator.
    """

    detector: Detector
    exposure: float
    time: float
    angle: float
    elapsed: float
    row_period: float
    roi: tuple[int, int, int, int]
    binning: int
    read_noise: float
    rng: np.random.Generator


class Effect(Protocol):
    """An effect is a frozen dataclass of its parameters.

    `final` marks the effect that ends its domain: photon noise, after which the photons have been counted.
    """

    name: ClassVar[str]
    domain: ClassVar[Domain]
    final: ClassVar[bool]


@runtime_checkable
class MotionEffect(Effect, Protocol):
    def times(self, times: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
        """When each row sees the sample: float64 [sample, row] in s after the trigger, averaged over the samples."""
        ...


@runtime_checkable
class ImageEffect(Effect, Protocol):
    def apply(self, image: Image, shot: Shot) -> Image:
        """The image float64 [row, col] in the effect's domain, changed; a new array."""
        ...


@dataclass(frozen=True)
class Chain:
    """Effects in an order that physics allows. Make one with `Chain.of`."""

    motion: tuple[MotionEffect, ...]
    images: tuple[ImageEffect, ...]

    @classmethod
    def of(cls, effects: Sequence[MotionEffect | ImageEffect]) -> Chain:
        """Check the order: motion, optical depth, photons (noise last), electrons, counts; each effect once.

        Raises:
            ValueError: in a sentence that names the two effects.
        """
        for i, effect in enumerate(effects):
            for earlier in effects[:i]:
                if earlier.name == effect.name:
                    raise ValueError(f"effect {effect.name!r} is named twice; name it once")
                if earlier.domain > effect.domain:
                    raise ValueError(
                        f"effect {effect.name!r} acts on {_words(effect.domain)} and cannot follow {earlier.name!r}, "
                        f"which acts on {_words(earlier.domain)}; the order is {', '.join(map(_words, Domain))}"
                    )
                if earlier.final and earlier.domain == effect.domain:
                    raise ValueError(
                        f"effect {effect.name!r} must come before {earlier.name!r}, which ends the "
                        f"{_words(effect.domain)}"
                    )
        return cls(
            tuple(effect for effect in effects if isinstance(effect, MotionEffect)),
            tuple(effect for effect in effects if isinstance(effect, ImageEffect)),
        )

    def apply(self, domain: Domain, image: Image, shot: Shot) -> Image:
        """The image after the effects of one domain."""
        for effect in _of(self.images, domain):
            image = effect.apply(image, shot)
        return image


def _of(effects: Iterable[ImageEffect], domain: Domain) -> Iterable[ImageEffect]:
    return (effect for effect in effects if effect.domain == domain)


def _words(domain: Domain) -> str:
    return domain.name.lower().replace("_", " ")
