"""Fit: the kind of methods that fit Gaussians, whose volume can grow while views arrive."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar, Self

from recon.base.method_kinds import Iterative

if TYPE_CHECKING:  # whoever asks whether a method is a fit loads none
    from collections.abc import Mapping

    from recon.base.choices import Start
    from recon.base.geometry import Geometry
    from recon.base.method import Clock, Plain
    from recon.splatting.gaussians import Gaussians
    from recon.splatting.settings import FitSettings
    from recon.splatting.stream import StreamingFit


class Fit(Iterative):
    """A fit of Gaussians with these settings, see `R2`; its volume can grow while views arrive."""

    takes: ClassVar[frozenset[str]] = frozenset({"device", "held_out", "checkpoints", "quality"})
    needs_matter: ClassVar[bool] = True

    steps: int | None
    seconds: float | None
    early_stop: bool
    gaussians: int | Gaussians | None
    start: Start
    finish: int | None
    fit: FitSettings

    @property
    def time_limit(self) -> float | None:
        return self.seconds

    @property
    def stops_early(self) -> bool:
        return self.early_stop

    @property
    @abstractmethod
    def planned_steps(self) -> int | None:
        """Number of steps; None if a time ends the fit."""

    @property
    @abstractmethod
    def provenance(self) -> tuple[FitSettings, Mapping[str, Plain]]:
        """All settings that determine the steps, which a resumed run must share, and more by name."""

    @property
    @abstractmethod
    def finish_sweeps(self) -> int:
        """Sweeps of total variation in the finish; 0 without a finish."""

    @abstractmethod
    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit alone, of this share of the rows, with this share of the steps."""

    @abstractmethod
    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit that grows while views with the geometry of `template`, whose angles are ignored, arrive.

        `seconds` is then the time of the last round, over all views.
        """
