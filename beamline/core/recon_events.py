"""Events of a reconstruction, of a reconstruction that follows a scan, and of trials."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beamline.core.events import Event, Listed, spread


class SnapshotWritten(Event, event="snapshot"):
    """The volume so far is in a file.

    Attributes:
        unlearnt: relative residual of new views before the fit has learnt them.
        method: whose volume it is, the one that predicts views held out better.
        errors: of each method in these views, in the measure of the volume.
    """

    path: Path
    picture: Path
    n_views: int
    seconds: float
    unlearnt: float | None
    method: str = ""
    errors: Mapping[str, float] | None = None


class SlicesDrawn(Event, event="slices"):
    """A picture has FBP slices of the views so far. degrees: angle of the half turn that the views cover."""

    picture: Path
    n_views: int
    degrees: float


class LawMeasured(Event, event="error_law"):
    """The law of the error (`recon.base.error_law`) as the live reconstruction measured it at the end of a pass.

    Attributes:
        number: of the pass, from 1.
        n_views: those that the live reconstruction used.
        exponent, exponent_error, noise, offset: as of `ErrorLaw`.
        gained: dB that the volume gained by this pass, as views held out measure it; None: not known.
        reason: why these views have no law; then the numbers of the law are NaN.
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
    """Progress of a fit or of iterations: the fields of `recon.base.method.Progress`, a rate and the time left.

    waiting: views of a growing scan that are in the file, and that no step has learnt yet.

    Numbers of another process are None where they are not finite.
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
    """Line integrals are ready, and the method begins. again: a live fit restarts because its axis has moved.

    more: of a finished scan, values by name; `axis_confident` is None where the axis was given.
    """

    file: Path | str
    method: str
    n_views: int
    axis_col: float
    again: bool | None = None
    more: Mapping[str, Any] = spread(default_factory=dict)


class ReconDone(Listed, event="recon_done"):
    """The live reconstruction wrote its volume; the values are those of its event `done`, see `VolumeDone`."""


class VolumeDone(Event, event="done"):
    """A reconstruction of this process has ended successfully; the event of another process is read as `Done`.

    record: of the volume, a `beamline.storage.recon_record.ReconRecord`.
    """

    record: Any = spread(lambda record: record.event_values())


class TrialsStarted(Event, event="trials_started"):
    """The trials of a table, `tradeoff` or `study`, begin. by: the metric that they are compared by."""

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
