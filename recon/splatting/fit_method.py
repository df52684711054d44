"""FitMethod: the interface of a fit of Gaussians, whose volume can grow while views arrive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

from recon.base.method import Method

if TYPE_CHECKING:  # whoever asks whether a method is a fit loads none
    from collections.abc import Mapping

    from recon.base.choices import Start
    from recon.base.geometry import Geometry
    from recon.base.method import Clock, Plain
    from recon.splatting.gaussians import Gaussians
    from recon.splatting.settings import FitSettings
    from recon.splatting.stream import StreamingFit


@runtime_checkable
class FitMethod(Method, Protocol):
    """A fit of Gaussians with these settings, see `R2`."""

    @property
    def steps(self) -> int | None: ...

    @property
    def seconds(self) -> float | None: ...

    @property
    def early_stop(self) -> bool: ...

    @property
    def allow_negative(self) -> bool: ...

    @property
    def gaussians(self) -> int | Gaussians | None: ...

    @property
    def start(self) -> Start: ...

    @property
    def finish(self) -> int | None: ...

    @property
    def fit(self) -> FitSettings: ...

    @property
    def planned_steps(self) -> int | None:
        """Number of steps; None if a time ends the fit."""

    @property
    def provenance(self) -> tuple[FitSettings, Mapping[str, Plain]]:
        """All settings that determine the steps, which a resumed run must share, and more by name."""

    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit alone, of this share of the rows, with this share of the steps."""

    @property
    def finish_sweeps(self) -> int:
        """Sweeps of total variation in the finish; 0 without a finish."""

    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit that grows while views with the geometry of `template`, whose angles are ignored, arrive.

        `seconds` is then the time of the last round, over all views.
        """
