"""FitMethod: what a fit of Gaussians is set to and plans, for those who ask; its volume can grow while views arrive."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

from recon.assess.time_model import MODEL_STEPS
from recon.base.arrays import F32
from recon.base.choices import Start
from recon.base.declared_types import Checked, Count, Natural, NonNegative
from recon.base.empirical import DEFAULT_STEPS
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method, Plain
from recon.splatting.finish import FINISH_SWEEPS
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings

if TYPE_CHECKING:
    from recon.splatting.stream import StreamingFit


@dataclass(frozen=True, eq=False)
class FitMethod(Checked, Method):
    """A fit of Gaussians with these settings, see `R2`."""

    steps: Natural | None = None
    seconds: NonNegative | None = None
    gaussians: Count | Gaussians | None = None
    start: Start = "fbp"
    early_stop: bool = False
    finish: Natural | None = None
    allow_negative: bool = False
    fit: FitSettings = field(default_factory=FitSettings)

    @property
    def planned_steps(self) -> int | None:
        """Number of steps that end the fit; None if only `seconds` do."""
        return DEFAULT_STEPS if self.steps is None and self.seconds is None else self.steps

    @property
    def by_content(self) -> bool:
        """Whether held-out views decide if the fit is worthwhile, see `finish.judged`."""
        given = self.steps is not None or self.seconds is not None or self.finish is not None
        return not (given or self.early_stop or isinstance(self.gaussians, Gaussians))

    @property
    def least_steps(self) -> int | None:
        """The fewest steps after which the data may end the fit; `planned_steps` if they cannot."""
        return MODEL_STEPS if self.by_content else self.planned_steps

    @property
    def finish_sweeps(self) -> int:
        """Sweeps of total variation in the finish; 0 without a finish."""
        return FINISH_SWEEPS if self.finish is None else self.finish

    @property
    def made_by(self) -> tuple[FitSettings, Mapping[str, Plain]]:
        """All settings that determine the steps, which a resumed run must share, and more by name."""
        assert not isinstance(self.gaussians, Gaussians)
        return self.fit, {"start": self.start, "gaussians": self.gaussians or 0}

    def as_candidate(self) -> Self:
        """The fit that competes with methods on voxels: it makes its own volume, whatever they predict."""
        return replace(self, steps=self.planned_steps) if self.by_content else self

    def for_part(self, share: float, of_time: float) -> Self:
        """The fit of this share of a volume: its share of the Gaussians, in this share of the seconds."""
        count, seconds = self.gaussians, self.seconds
        return replace(
            self,
            gaussians=max(1, round(share * count)) if isinstance(count, int) else count,
            seconds=None if seconds is None else of_time * seconds,
        )

    def for_trial(self, share: float, of_steps: float) -> Self:
        """The fit alone, of this share of the rows, with this share of the steps."""
        steps = None if self.planned_steps is None else round(of_steps * self.planned_steps)
        return replace(self.for_part(share, 1.0), steps=steps, finish=0)

    @abstractmethod
    def in_time(self, projections: F32, geometry: Geometry, seed: int, left: Callable[[], float]) -> Self:
        """Start the fit on these views; the result runs within the seconds that are then `left`."""

    @abstractmethod
    def stream(self, template: Geometry, seed: int, now: Clock) -> StreamingFit:
        """A fit that grows while views with the geometry of `template`, whose angles are ignored, arrive.

        `seconds` is then the time of the last round, over all views.
        """
