"""Options of a reconstruction: which scan and how it is read, which part of it, by which method, and where it goes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from beamline.projections.selection import Selection
from beamline.reconstruct.checkpoints import Keeper
from beamline.reconstruct.result import Target
from beamline.storage.readers.open import Quantity, ScanSource, open_scan
from recon.assess.time_model import Quality
from recon.reconstruction import Method
from recon.splatting.initialise import Start
from recon.splatting.problem import Loss
from recon.voxels.fbp import Filter


@dataclass(frozen=True)
class SourceOptions:
    """Which scan, and what to take instead of what its file says (see storage.source.open_scan)."""

    path: Path
    quantity: Quantity | None = None
    angles: Path | None = None
    angle_rows: str | None = None
    darks: Path | None = None
    flats: Path | None = None

    def open(self, *, follow: bool = False) -> ScanSource:
        return open_scan(
            self.path,
            angles=self.angles,
            angle_rows=self.angle_rows,
            darks=self.darks,
            flats=self.flats,
            quantity=self.quantity,
            follow=follow,
        )


@dataclass(frozen=True)
class ReconOptions:
    """What to reconstruct and how.

    Attributes:
        source: the scan.
        target: where results go.
        selection: which part of the scan, and its correction.
        method: of recon.reconstruct.
        steps: of the fit; None takes the reconstructor's own number.
        seconds: at most, for the fit; for a followed scan, after its end.
        budget: s for everything from line integrals to volume; chooses all settings of the fit.
        quality: a preset instead of steps and Gaussians.
        gaussians: how many to start from; None derives it from the volume.
        start, loss, device: of the fit.
        early_stop: end the fit when views held out no longer gain; some are kept back where all were chosen.
        polish: sweeps on voxels after the fit.
        keeper: of the fit's state.
        iterations, tv_weight: of an iterative method; None takes its own.
        filter: of the FBP.
        seed: of everything random.
        truth: FILE or FILE:first:end to compare with.
        unfinished: take the frames that there are, where the scan still runs or died.
        command: that repeats this, for the record.
    """

    source: SourceOptions
    target: Target
    selection: Selection
    method: Method = "r2"
    steps: int | None = None
    seconds: float | None = None
    budget: float | None = None
    quality: Quality | None = None
    gaussians: int | None = None
    start: Start = "fbp"
    loss: Loss = "l1"
    device: str = "cpu"
    early_stop: bool = False
    polish: int = 0
    keeper: Keeper = field(default_factory=Keeper)
    iterations: int | None = None
    tv_weight: float | None = None
    filter: Filter = "hann"
    seed: int = 0
    truth: str | None = None
    unfinished: bool = False
    command: str = ""
