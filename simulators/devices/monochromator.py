"""Simulated monochromator: the beam of the scene has its energy, and materials attenuate as they do there."""

from __future__ import annotations

from collections.abc import Callable

from drivers.base.clock import Clock
from simulators.scenes.scene import Scene

POLL = 0.05  # s between looks at who may end the wait


class SimulatedMonochromator:
    """Implements `drivers.base.protocols.Monochromator` and `Watchable`.

    Args:
        energy: keV of the scene as it is; None: it states none.
        scene_at: the scene at an energy in keV; an error of it leaves the monochromator where it stands.
        show: takes the sample and the beam of all later frames.
        settle: s that each move takes.
    """

    def __init__(
        self,
        energy: float | None,
        scene_at: Callable[[float], Scene],
        show: Callable[[Scene], None],
        clock: Clock,
        settle: float = 0.0,
        name: str = "monochromator",
    ) -> None:
        self.name = name
        self._energy, self._scene_at, self._show = energy, scene_at, show
        self._clock, self._settle = clock, settle
        self._check: Callable[[], None] = lambda: None

    def watch(self, check: Callable[[], None]) -> None:
        self._check = check

    def move_to(self, energy: float) -> None:
        if energy == self._energy:
            return
        scene = self._scene_at(energy)
        deadline = self._clock.now() + self._settle
        while (left := deadline - self._clock.now()) > 0:
            self._check()
            self._clock.sleep(min(POLL, left))
        self._show(scene)
        self._energy = energy

    def energy(self) -> float | None:
        return self._energy
