"""The PM16C's trigger output: which of its pulse widths fits a train."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.protocols import TriggerTrain

MODES = {1e-3: 5, 100e-6: 4, 10e-6: 3, 200e-9: 2}
"""Pulse width in s, the widest first -> TMGM mode."""


@dataclass(frozen=True)
class PulseWidths:
    """The widths that a train may take, the widest first; `chosen` by the configuration, or all that there are.

    Raises:
        ValueError: the output has no such width.
    """

    chosen: float | None = None

    def __post_init__(self) -> None:
        if self.chosen is not None and self.chosen not in MODES:
            raise ValueError(
                f"the trigger output has no pulses of {self.chosen:g} s; it has {', '.join(f'{w:g}' for w in MODES)} s"
            )

    @property
    def allowed(self) -> list[float]:
        return list(MODES) if self.chosen is None else [self.chosen]

    @property
    def narrowest(self) -> float:
        """s."""
        return min(self.allowed)

    def widest_for(self, train: TriggerTrain, fastest: float) -> float | None:
        """The widest that leaves the output low as long as high at `fastest` counts/s; None where none does.

        Wider pulses would run together: the controller leaves the output high then.
        """
        pitch = math.inf if train.n == 1 else abs(train.interval) / fastest
        return next((width for width in self.allowed if 2 * width <= pitch), None)
