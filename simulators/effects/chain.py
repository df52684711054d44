"""Chain: the effects of a scene in order, from the moving sample to the counts; the order is checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from simulators.effects.catalogue import CATALOGUE, FINAL, Domain, class_of, order_error
from simulators.frame.shot import Image, Moments, Pose, Shot


class Effect(Protocol):
    """An effect is a frozen dataclass of its parameters.

    The catalogue gives its `name`, its `domain`, and `final` for the last effect of a domain. These are photon noise,
    read noise (of electrons) and the converter (of counts). An effect outside the catalogue defines all three itself.
    """

    name: ClassVar[str]
    domain: ClassVar[Domain]
    final: ClassVar[bool]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name, row in CATALOGUE.items():
            if (row.module, class_of(name)) == (cls.__module__, cls.__name__):
                cls.name, cls.domain, cls.final = name, row.domain, name in FINAL


@runtime_checkable
class SamplingEffect(Effect, Protocol):
    def moments(self, moments: Moments, shot: Shot) -> Moments:
        """Additional times at which each row is exposed; a frame is the weighted mean over them."""


@runtime_checkable
class PoseEffect(Effect, Protocol):
    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        """The changed pose of the sample at `times` (float64 [row], s after the trigger)."""


@runtime_checkable
class AreaEffect(Effect, Protocol):
    @property
    def offsets(self) -> Sequence[tuple[float, float]]:
        """(row, col) of each ray of a pixel, in pixels from its middle; the intensity of the pixel is the mean over
        these rays."""


@runtime_checkable
class ImageEffect(Effect, Protocol):
    def apply(self, image: Image, shot: Shot) -> Image:
        """The changed image, float64 [row, col] in the effect's domain. The effect may work in place."""


@runtime_checkable
class Anomaly(Effect, Protocol):
    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        """Regions in which the anomaly changes this frame, regardless of other effects; empty if it does not change."""


AnyEffect: TypeAlias = SamplingEffect | PoseEffect | AreaEffect | ImageEffect


@dataclass(frozen=True)
class Chain:
    """Effects in an order that physics allows. `Chain.of` creates it."""

    effects: tuple[AnyEffect, ...]

    @classmethod
    def of(cls, effects: Sequence[AnyEffect]) -> Chain:
        """Check the order: motion, optical depth, photons (noise last), electrons (read noise last), counts.

        Within a domain, the order is that of the catalogue. Each effect may occur once.

        Raises:
            ValueError: the order is wrong; the message names the two effects.
        """
        for i, effect in enumerate(effects):
            for earlier in effects[:i]:
                if earlier.name == effect.name:
                    raise ValueError(f"effect {effect.name!r} is given twice")
                if earlier.domain > effect.domain:
                    raise ValueError(
                        f"effect {effect.name!r} acts on {effect.domain.words} and cannot follow {earlier.name!r}, "
                        f"which acts on {earlier.domain.words}; the order is "
                        f"{', '.join(domain.words for domain in Domain)}"
                    )
                if earlier.final and earlier.domain == effect.domain:
                    raise ValueError(
                        f"effect {effect.name!r} must come before {earlier.name!r}, which ends the "
                        f"{effect.domain.words}"
                    )
                if wrong := order_error(earlier.name, effect.name):
                    raise ValueError(wrong)
        return cls(tuple(effects))

    @property
    def moves(self) -> bool:
        """True if frames depend on other times than the time of the trigger."""
        return any(isinstance(effect, SamplingEffect) for effect in self.effects)

    def moments(self, shot: Shot) -> Moments:
        """Times of an exposure. Without motion blur there is only its middle, as a reconstruction assumes."""
        moments = Moments.once(shot.detector.shape[0], shot.exposure / 2)
        for effect in self.effects:
            if isinstance(effect, SamplingEffect):
                moments = effect.moments(moments, shot)
        return moments

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        for effect in self.effects:
            if isinstance(effect, PoseEffect):
                pose = effect.pose(pose, times, shot)
        return pose

    @property
    def rays(self) -> Sequence[tuple[float, float]]:
        """(row, col) of each ray of a pixel, in pixels from its middle."""
        return next((effect.offsets for effect in self.effects if isinstance(effect, AreaEffect)), [(0.0, 0.0)])

    def apply(self, domain: Domain, image: Image, shot: Shot) -> Image:
        """The image after the effects of one domain."""
        for effect in self.effects:
            if effect.domain == domain and isinstance(effect, ImageEffect):
                image = effect.apply(image, shot)
        return image

    def labels(self, shot: Shot) -> tuple[AnomalyLabel, ...]:
        """The anomalies of a frame. The region of an anomaly that turns with the sample covers the whole exposure."""
        labels: dict[tuple[str, int], AnomalyLabel] = {}
        for effect in self.effects:
            if isinstance(effect, Anomaly):
                depth = effect.domain == Domain.OPTICAL_DEPTH and self.moves and shot.beam and shot.sample
                moments = [shot.later(float(times[0])) for times in self.moments(shot).times] if depth else [shot]
                for label in (label for moment in moments for label in effect.labels(moment)):
                    key = label.kind, label.which
                    labels[key] = labels.get(key, label).joined(label)
        return tuple(labels.values())


VISIBLE = 1e-3  # smallest change of the intensity that is labelled, as a share
NARROWEST = 1e-9  # mm: an edge with a smaller penumbra is a step


def _in_order(views: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= views[0] < views[1]:
        raise ValueError(f"must be [first, one after the last] with 0 <= first < last, got {list(views)}")
    return views


ViewRange = Annotated[tuple[int, int], AfterValidator(_in_order)]
"""First projection and the one after the last. A flat belongs to the projection that is exposed next."""


@dataclass(frozen=True)
class AnomalyLabel:
    """An anomaly that a monitor should find in a frame.

    Attributes:
        kind: the anomaly's name.
        region: (first row, row after the last, first column, column after the last) in pixels of the frame.
        which: number of the anomaly among several of one kind; the same in every frame.
    """

    kind: str
    region: tuple[int, int, int, int]
    which: int = 0

    def joined(self, second: AnomalyLabel) -> AnomalyLabel:
        """This label with a region that includes the region of the other label."""
        (top, below, left, right), region = self.region, second.region
        joined = min(top, region[0]), max(below, region[1]), min(left, region[2]), max(right, region[3])
        return AnomalyLabel(self.kind, joined, self.which)


def within(views: ViewRange | None, shot: Shot) -> bool:
    """True if the shot lies in the range, or if there is no range."""
    return views is None or views[0] <= shot.view < views[1]


def exposed_share(inside: NDArray[np.float64], penumbra: float) -> NDArray[np.float64]:
    """Share of the light at `inside` mm within the edge of a slit (negative: behind it), with a penumbra in mm.

    The edge covers more and more of an evenly bright source: a ramp, half of the light at the edge itself.
    """
    return np.clip(0.5 + inside / max(penumbra, NARROWEST), 0.0, 1.0)
