"""The result of a scan: what its caller gets, and what the events `scan_done` and `done` say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class RunResult:
    """A scan that has ended; `beamline.api` calls it ScanResult.

    Attributes:
        path: the scan file; its folder holds everything else. The file that joins the parts of a resumed run.
        n_frames: rows of the file.
        missing: planned rows without a frame (a scan that misses some raises; the event `scan_done` names them).
        flags: frames that the monitor flagged: their number by check, then by level.
        alarmed_frames: frames with an alarm, without those that were taken again.
        alarmed_views: views among them.
        retaken: views that were taken again, because they had one or gave no frame.
        reference_faults: what is wrong with darks and flats, a sentence or more a group.
        seconds: real time of the whole run.
        bytes: size of the file that was written.
        recon: data of the live reconstruction's `done` event; None without one, or where it failed.
        status: `complete`, `stopped` or `failed`.
        returned: views on the way back, with the motion of the sample (`beamline.projections.returned.ReturnedView`).
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
    returned: Sequence[Any] = ()
    sample: str = ""

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.path.parent

    @property
    def frames(self) -> int:
        """`n_frames`, as scripts call it."""
        return self.n_frames

    @property
    def alarms(self) -> int:
        """`alarmed_frames`, as scripts call it."""
        return self.alarmed_frames

    @property
    def volume(self) -> Path | None:
        """File of the reconstruction; None without one, or if it failed."""
        return None if self.recon is None else Path(str(self.recon["output"]))

    @property
    def clean(self) -> bool:
        """Whether the scan is complete, without a fault of frames, darks or flats."""
        return self.status == "complete" and not (self.missing or self.alarmed_frames or self.reference_faults)

    def file_values(self) -> dict[str, Any]:
        """What the event `scan_done` says when the file is closed, by name."""
        without = ("sample",) if self.returned else ("sample", "returned")
        return {name: value for name, value in vars(self).items() if name not in without}

    def run_values(self) -> dict[str, Any]:
        """What the event `done` says of a run that has ended well, by name."""
        return {name: value for name, value in vars(self).items() if name not in ("sample", "status")}
