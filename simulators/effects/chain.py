"""Chain: the order of effects from the moving sample to the counts, checked once when a scene is made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from simulators.effects.order import problem
from simulators.frame.domain import Domain
from simulators.frame.pose import Pose
from simulators.frame.shot import Image, Moments, Shot

Watch: TypeAlias = Callable[[str], AbstractContextManager[object]]
"""Entered around each step of an exposure with its name: what measures the cost of effects."""


class Effect(Protocol):
    """An effect is a frozen dataclass of its parameters.

    `name` is that of its module; `final` marks what ends its domain: photon noise, after which the photons are counted,
    read noise, with which the charge is read, and the converter.
    """

    name: ClassVar[str]
    domain: ClassVar[Domain]
    final: ClassVar[bool]


@runtime_checkable
class SamplingEffect(Effect, Protocol):
    def moments(self, moments: Moments, shot: Shot) -> Moments:
        """When each row sees the sample, refined: a frame is the weighted mean over the moments."""
        ...


@runtime_checkable
class PoseEffect(Effect, Protocol):
    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        """How the sample stands at `times` (float64 [row], s after the trigger), changed."""
        ...


@runtime_checkable
class ImageEffect(Effect, Protocol):
    def apply(self, image: Image, shot: Shot) -> Image:
        """The image float64 [row, col] in the effect's domain, changed. The image is the effect's own: it may write
        over it and give it back."""
        ...


SEEN = 1e-3
"""Share of the light from which on a change counts as seen: where labels begin and end."""


@dataclass(frozen=True)
class Label:
    """What a monitor should find in a frame.

    Attributes:
        kind: the anomaly's name.
        region: (first row, row after the last, first column, column after the last) in pixels of the frame.
        which: of several of one kind in a frame; it is the same in every frame.
    """

    kind: str
    region: tuple[int, int, int, int]
    which: int = 0


@runtime_checkable
class Anomaly(Effect, Protocol):
    def labels(self, shot: Shot) -> Sequence[Label]:
        """Where the anomaly changes this frame, whatever other effects do to it; none where it does not."""
        ...


AnyEffect: TypeAlias = SamplingEffect | PoseEffect | ImageEffect


@dataclass(frozen=True)
class Chain:
    """Effects in an order that physics allows. Make one with `Chain.of`."""

    effects: tuple[AnyEffect, ...]

    @classmethod
    def of(cls, effects: Sequence[AnyEffect]) -> Chain:
        """Check the order: motion, optical depth, photons (noise last), electrons (the readout's noise last), counts,
        and what order.py says of a domain's own; each effect once.

        Raises:
            ValueError: in a sentence that names the two effects.
        """
        for i, effect in enumerate(effects):
            for earlier in effects[:i]:
                if earlier.name == effect.name:
                    raise ValueError(f"effect {effect.name!r} is named twice; name it once")
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
                if wrong := problem(earlier.name, effect.name):
                    raise ValueError(wrong)
        return cls(tuple(effects))

    @property
    def moves(self) -> bool:
        """Whether a frame looks at other moments than the trigger."""
        return any(isinstance(effect, SamplingEffect) for effect in self.effects)

    def moments(self, shot: Shot) -> Moments:
        moments = Moments.at_trigger(shot.detector.shape[0])
        for effect in self.effects:
            if isinstance(effect, SamplingEffect):
                moments = effect.moments(moments, shot)
        return moments

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        for effect in self.effects:
            if isinstance(effect, PoseEffect):
                pose = effect.pose(pose, times, shot)
        return pose

    def apply(self, domain: Domain, image: Image, shot: Shot, watch: Watch = nullcontext) -> Image:
        """The image after the effects of one domain."""
        for effect in self.effects:
            if effect.domain == domain and isinstance(effect, ImageEffect):
                with watch(effect.name):
                    image = effect.apply(image, shot)
        return image

    def labels(self, shot: Shot) -> tuple[Label, ...]:
        """The anomalies of a frame; one that turns with the sample, wherever it is while the frame looks."""
        found: dict[tuple[str, int], Label] = {}
        for effect in self.effects:
            if isinstance(effect, Anomaly):
                depth = effect.domain == Domain.OPTICAL_DEPTH and self.moves and shot.beam and shot.sample
                looks = [shot.later(float(times[0])) for times in self.moments(shot).times] if depth else [shot]
                for label in (label for look in looks for label in effect.labels(look)):
                    key = label.kind, label.which
                    found[key] = _around(found.get(key, label), label)
        return tuple(found.values())


def _around(one: Label, other: Label) -> Label:
    """One label around two of the same."""
    (top, below, left, right), region = one.region, other.region
    around = min(top, region[0]), max(below, region[1]), min(left, region[2]), max(right, region[3])
    return Label(one.kind, around, one.which)
