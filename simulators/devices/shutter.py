"""Simulated devices in the beam, which the simulated camera shows: shutter, sample mover and monochromator."""

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


class SimulatedShutter:
    """Implements `drivers.base.protocols.Shutter`; it starts closed, as a beamline does."""

    by_hand = False

    def __init__(self, name: str = "shutter") -> None:
        self.name = name
        self._open = False

    def open(self) -> None:
        self._open = True

    def close(self) -> None:
        self._open = False

    def is_open(self) -> bool:
        return self._open


class SimulatedSampleMover:
    """Implements `drivers.base.protocols.SampleMover`; it starts with the sample in the beam."""

    def __init__(self, name: str = "sample mover") -> None:
        self.name = name
        self._in = True

    def out(self) -> None:
        self._in = False

    def back(self) -> None:
        self._in = True

    def is_in(self) -> bool:
        """Whether the sample is in the beam; the simulated camera asks it."""
        return self._in
