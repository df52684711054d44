"""The result of a scan, for its caller and for the events `scan_done` and `done`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class RunResult:
    """A scan that has ended; `beamline.api` calls it ScanResult.

    Attributes:
        path: the scan file; for a resumed run, the file that joins its parts. Its folder contains everything else.
        n_frames: rows of the file.
        missing: planned rows without a frame. If there are any, the scan raises an error; the event `scan_done` lists
            them.
        flags: frames that the monitor flagged: their number by check, then by level.
        alarmed_frames: frames with an alarm, without those that were taken again.
        alarmed_views: projections among the frames with an alarm.
        retaken: projections that were taken again, because they had an alarm or gave no frame.
        reference_faults: faults of darks and flats, one or more sentences for each group.
        seconds: real time of the whole run.
        bytes: size of the file that was written.
        recon: data of the `done` event of the live reconstruction; None if there was none, or if it failed.
        status: `complete`, `stopped` or `failed`.
        sample: its name.
    """

    path: Path
    n_frames: int
    missing: Sequence[int]
    flags: Mapping[str, Mapping[str, int]]
    alarmed_frames: int
    alarmed_views: int
    retaken: int
    reference_faults: Sequence[str]
    seconds: float
    bytes: int
    recon: Mapping[str, Any] | None
    status: str
    sample: str = ""

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.path.parent

    @property
    def frames(self) -> int:
        """Number of frames; the name of `n_frames` in scripts."""
        return self.n_frames

    @property
    def alarms(self) -> int:
        """Frames with an alarm; the name of `alarmed_frames` in scripts."""
        return self.alarmed_frames

    @property
    def volume(self) -> Path | None:
        """File of the reconstruction; None if there was none or it failed."""
        return None if self.recon is None else Path(str(self.recon["output"]))

    @property
    def clean(self) -> bool:
        """True if the scan is complete and no projection, dark or flat has a fault."""
        return self.status == "complete" and not (self.missing or self.alarmed_frames or self.reference_faults)

    def file_values(self) -> dict[str, Any]:
        """Values of the event `scan_done`, by name, when the file is closed."""
        return {name: value for name, value in vars(self).items() if name != "sample"}

    def run_values(self) -> dict[str, Any]:
        """Values of the event `done`, by name, of a run that has ended successfully."""
        return {name: value for name, value in vars(self).items() if name not in ("sample", "status")}
