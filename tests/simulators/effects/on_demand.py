"""On demand: a scene with any choice of effects of the catalogue, and frames in which each effect is visible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.volume import Grid
from simulators.effects.catalogue import CATALOGUE
from simulators.frame.shot import Detector, Pose, Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.effects.parameters import entry

FRAMES = (0, 1, 4)
"""A dark, a flat and projection 2 (projections begin with frame 2); every effect is visible in one of these frames."""


@dataclass(frozen=True)
class Cloud:
    """A round Gaussian cloud: the simplest sample that follows a pose, without a compiled kernel."""

    place: tuple[float, float, float] = (0.1, 0.05, 0.02)
    sigma: float = 0.08
    radius: float = 0.3
    names: tuple[str, ...] = ("cloud",)

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        pose = angle if isinstance(angle, Pose) else Pose.turned(angle, detector.shape[0])
        axes, origin = pose.frames()
        middle = np.einsum("rij,ri->rj", axes, np.array(self.place) - origin)
        away = (detector.u() - middle[:, :1]) ** 2 + (detector.v()[:, None] - middle[:, 2:]) ** 2
        return 1.5 * np.exp(-0.5 * away / self.sigma**2)

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        raise NotImplementedError("no test asks for it")

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        raise NotImplementedError("no test asks for it")


def scene(names: Sequence[str]) -> Scene:
    """A cloud with 4000 photons per frame and these effects, in the order of the catalogue."""
    chosen = [entry(name) for name in CATALOGUE if name in names]
    return replace(shots.scene(*chosen, flux=4000.0), sample=Cloud())


def shot(frame: int) -> Shot:
    """A shot of 1 s with a stage that turns slowly backwards, and a camera whose rows start late."""

    def stage(time: float) -> float:
        return 0.4 - 0.05 * (time - 1000.0)

    time = 1000.0 + 2.0 * frame
    return shots.shot(
        detector=Detector.centred((40, 60), 0.015),
        roi=(1132, 2016, 40, 60),
        exposure=1.0,
        time=time,
        angle=stage(time),
        angle_at=stage,
        elapsed=2.0 * frame,
        row_period=5e-3,
        frame=frame,
        beam=frame > 0,
        sample=frame > 1,
        view=max(frame - 2, 0),
    )


def frames(of: Scene, numbers: Sequence[int] = FRAMES) -> list[NDArray[np.uint16]]:
    return [expose(of, shot(number)) for number in numbers]


def same(one: Sequence[NDArray[Any]], other: Sequence[NDArray[Any]]) -> bool:
    """Whether frames are bit-identical."""
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
