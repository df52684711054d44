"""Fit: base class of the methods that fit Gaussians. These methods can also reconstruct during a scan."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar, Self

from recon.base.method_kinds import Iterative

if TYPE_CHECKING:  # code that only checks whether a method is a fit must not load these modules
    from collections.abc import Mapping

    from recon.base.choices import Start
    from recon.base.geometry import Geometry
    from recon.base.method import Clock, Plain
    from recon.splatting.gaussians import Gaussians
    from recon.splatting.settings import FitSettings
    from recon.splatting.stream import StreamingFit


class Fit(Iterative):
    """A method that fits Gaussians, see `R2`. It can also reconstruct during a scan."""

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
        """Number of steps; None if a time limit ends the fit."""

    @property
    @abstractmethod
    def provenance(self) -> tuple[FitSettings, Mapping[str, Plain]]:
        """All settings that determine the steps, and further values, by name. A resumed run must have the same
        settings."""

    @property
    @abstractmethod
    def finish_sweeps(self) -> int:
        """Number of total-variation iterations in the voxel refinement; 0: no voxel refinement."""

    @abstractmethod
    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit for a test reconstruction: without voxel refinement, for this fraction of the rows, with this
        fraction of the steps."""

    @abstractmethod
    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit that takes projections during a scan. They have the geometry of `template`, apart from its angles.

        The setting `seconds` of the method becomes the time limit of the final fit to all projections.
        """
