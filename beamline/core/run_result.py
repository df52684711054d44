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
        path: the scan file. For a resumed run, the file with all parts. Its folder contains all other files of the run.
        n_frames: number of frames in the file. missing: planned frames that are not in the file. If frames are missing,
            the scan raises an error; the event `scan_done` lists the missing frames.
        flags: number of frames that the monitor flagged, by check and level. alarmed_frames: number of frames with an
            alarm, without those that were taken again. alarmed_views: number of projections among the frames with an
            alarm. retaken: number of projections that were taken again, because they had an alarm or their frame was
            missing. reference_faults: faults of darks and flats, one or more sentences for each group.
        seconds: real time of the whole run.
        bytes: size of the file that was written.
        recon: data of the event `done` of the live reconstruction; None if there was no live reconstruction, or if it
            failed. status: `complete`, `stopped` or `failed`. sample: name of the sample.
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
        """Number of frames. Scripts use this name instead of `n_frames`."""
        return self.n_frames

    @property
    def alarms(self) -> int:
        """Number of frames with an alarm. Scripts use this name instead of `alarmed_frames`."""
        return self.alarmed_frames

    @property
    def volume(self) -> Path | None:
        """File of the reconstruction; None if there was no reconstruction, or if it failed."""
        return None if self.recon is None else Path(str(self.recon["output"]))

    @property
    def clean(self) -> bool:
        """True if the scan is complete and no projection, dark or flat has a fault."""
        return self.status == "complete" and not (self.missing or self.alarmed_frames or self.reference_faults)

    def file_values(self) -> dict[str, Any]:
        """Values of the event `scan_done` by name. The event is sent when the file is closed."""
        return {name: value for name, value in vars(self).items() if name != "sample"}

    def run_values(self) -> dict[str, Any]:
        """Values, by name, of the event `done` of a run that has ended successfully."""
        return {name: value for name, value in vars(self).items() if name not in ("sample", "status")}
