"""Events of a reconstruction, of a reconstruction that follows a scan, and of trials."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beamline.core.events import Event, Listed, spread

ALL_SHOWN = "shown"
"""State of a live reconstruction whose picture shows all projections of its scan."""


class SnapshotWritten(Event, event="snapshot"):
    """The live volume was written to a file.

    Attributes:
        unlearnt: relative residual of new projections before the fit has used them.
        method: the method of this volume. It predicts held-out projections better than the other method. errors: error
            of each method in the held-out projections, relative to the volume.
    """

    path: Path
    picture: Path
    n_views: int
    seconds: float
    unlearnt: float | None
    method: str = ""
    errors: Mapping[str, float] | None = None


class SlicesDrawn(Event, event="slices"):
    """A picture with FBP slices of the projections so far. degrees: angle, of the 180°, that the projections cover."""

    picture: Path
    n_views: int
    degrees: float


class LawMeasured(Event, event="error_law"):
    """The error model (`recon.base.error_law`) that the live reconstruction measured at the end of a pass.

    Attributes:
        number: number of the pass, from 1.
        n_views: number of projections that the live reconstruction used.
        exponent, exponent_error, noise, offset: as in `ErrorLaw`.
        gained: improvement in dB of the volume by this pass, measured with held-out projections; None: not known.
            reason: why no error model could be measured. The numbers of the model are then NaN.
    """

    number: int
    n_views: int
    exponent: float
    exponent_error: float
    noise: float
    offset: float
    gained: float | None = None
    reason: str = ""


class FitReached(Event, event="progress"):
    """Progress of a fit or of iterations: the fields of `recon.base.method.Progress`, a rate and the remaining time.

    waiting: for a running scan, number of projections in its file that no step has used yet.

    Numbers from another process are None if they are not finite.
    """

    stage: str
    step: int
    steps: int
    seconds: float
    loss: float | None
    residual: float | None
    n_gaussians: int
    n_views: int
    held_out: float | None
    unit: str
    per_s: float | None
    eta_s: float | None
    waiting: int = 0


class ReconStarted(Event, event="recon_started"):
    """The line integrals are ready, and the method starts. again: True if a live fit starts again because its axis has
    changed.

    more: further values of a finished scan, by name; `axis_confident` is None if the user gave the axis.
    """

    file: Path | str
    method: str
    n_views: int
    axis_col: float
    again: bool | None = None
    more: Mapping[str, Any] = spread(default_factory=dict)


class ReconDone(Listed, event="recon_done"):
    """The live reconstruction has written its volume. The values are those of the event `done` of the reconstruction,
    see `VolumeDone`."""


class VolumeDone(Event, event="done"):
    """A reconstruction of this process has ended successfully. (The event of another process is read as `Done`.)

    record: the record of the volume, a `beamline.storage.recon_record.ReconRecord`.
    """

    record: Any = spread(lambda record: record.event_values())


class TrialsStarted(Event, event="trials_started"):
    """A command (`tradeoff`, `study` or `sweep`) starts its trials. by: the metric that compares the trials."""

    file: Path | str
    table: str
    trials: int
    left_out: int
    by: str


class TrialDone(Event, event="trial"):
    """One trial or row has ended. figures: its settings and metrics, by name."""

    n: int
    of: int
    label: str
    status: str
    seconds: float
    message: str
    quality_db: float
    peak_bytes: int | None
    figures: Mapping[str, Any] = spread()
