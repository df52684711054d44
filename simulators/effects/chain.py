"""Chain: a scene's effects in order, from the moving sample to the counts; the order is checked once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from simulators.effects.anomaly import Label
from simulators.effects.catalogue import CATALOGUE, FINAL, Domain, order_error
from simulators.frame.pose import Pose
from simulators.frame.shot import Image, Moments, Shot

StepHook: TypeAlias = Callable[[str], AbstractContextManager[object]]
"""A context that is entered with the name of each step of an exposure, to measure its cost."""


class Effect(Protocol):
    """An effect is a frozen dataclass of its parameters.

    `name` is the name of its module. The catalogue gives its `domain`, and `final` for the last effect of a domain.
    These are photon noise, read noise (of electrons) and the converter (of counts). An effect outside the catalogue
    states all three.
    """

    name: ClassVar[str]
    domain: ClassVar[Domain]
    final: ClassVar[bool]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        name = cls.__module__.rpartition(".")[2]
        if entry := CATALOGUE.get(name):
            cls.name, cls.domain, cls.final = name, entry.domain, name in FINAL


@runtime_checkable
class SamplingEffect(Effect, Protocol):
    def moments(self, moments: Moments, shot: Shot) -> Moments:
        """More moments at which each row is exposed: a frame is the weighted mean over them."""


@runtime_checkable
class PoseEffect(Effect, Protocol):
    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        """The changed pose of the sample at `times` (float64 [row], s after the trigger)."""


@runtime_checkable
class AreaEffect(Effect, Protocol):
    @property
    def offsets(self) -> Sequence[tuple[float, float]]:
        """(row, col) of each ray of a pixel, in pixels from its middle: its light is the mean over them."""


@runtime_checkable
class ImageEffect(Effect, Protocol):
    def apply(self, image: Image, shot: Shot) -> Image:
        """The changed image, float64 [row, col] in the effect's domain. The effect may work in place."""


@runtime_checkable
class Anomaly(Effect, Protocol):
    def labels(self, shot: Shot) -> Sequence[Label]:
        """Where the anomaly changes this frame, regardless of other effects; empty without a change."""


AnyEffect: TypeAlias = SamplingEffect | PoseEffect | AreaEffect | ImageEffect


@dataclass(frozen=True)
class Chain:
    """Effects in an order that physics allows. Created by `Chain.of`."""

    effects: tuple[AnyEffect, ...]

    @classmethod
    def of(cls, effects: Sequence[AnyEffect]) -> Chain:
        """Check the order: motion, optical depth, photons (noise last), electrons (the readout's noise last), counts.

        Within a domain the catalogue's order holds. Each effect may occur once.

        Raises:
            ValueError: a wrong order; the message names the two effects.
        """
        for i, effect in enumerate(effects):
            for earlier in effects[:i]:
                if earlier.name == effect.name:
                    raise ValueError(f"effect {effect.name!r} is named twice")
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
        """Whether frames depend on other moments than the trigger."""
        return any(isinstance(effect, SamplingEffect) for effect in self.effects)

    def moments(self, shot: Shot) -> Moments:
        """Of an exposure. Without blur there is one, the middle of the exposure, as a reconstruction assumes."""
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

    def apply(self, domain: Domain, image: Image, shot: Shot, on_step: StepHook = nullcontext) -> Image:
        """The image after the effects of one domain."""
        for effect in self.effects:
            if effect.domain == domain and isinstance(effect, ImageEffect):
                with on_step(effect.name):
                    image = effect.apply(image, shot)
        return image

    def labels(self, shot: Shot) -> tuple[Label, ...]:
        """The anomalies of a frame. The region of an anomaly that turns with the sample covers the whole exposure."""
        labels: dict[tuple[str, int], Label] = {}
        for effect in self.effects:
            if isinstance(effect, Anomaly):
                depth = effect.domain == Domain.OPTICAL_DEPTH and self.moves and shot.beam and shot.sample
                moments = [shot.later(float(times[0])) for times in self.moments(shot).times] if depth else [shot]
                for label in (label for moment in moments for label in effect.labels(moment)):
                    key = label.kind, label.which
                    labels[key] = labels.get(key, label).joined(label)
        return tuple(labels.values())
