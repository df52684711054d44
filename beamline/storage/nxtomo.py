"""NXtomoWriter: a scan's file while it grows, in a state that a reader can trust after every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Self

from beamline.digest import FrameDigest
from drivers.clock import Clock
from drivers.frame import Frame

Description = Mapping[str, str | int | float]


@dataclass(frozen=True)
class ScanInfo:
    """What is known about a scan before its first frame; None where it is not known.

    Attributes:
        sample: name; title: one line for people.
        pixel_size_mm: at the sample; energy_kev; distance_mm: sample to detector.
        exposure, period: s.
        axis_col: rotation axis in 0-based pixel-centre columns.
        plan: JSON; config: YAML; both as text for the record.
        devices: what each device says of itself, by its name.
    """

    sample: str
    title: str = ""
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    distance_mm: float | None = None
    exposure: float | None = None
    period: float | None = None
    axis_col: float | None = None
    plan: str = "{}"
    config: str = ""
    devices: Mapping[str, Description] = field(default_factory=lambda: MappingProxyType({}))


class NXtomoWriter:
    """Writes uint16 frames row by row (SWMR); never overwrites a file.

    Every append leaves pixels, digest and record of the frame in the file before `frames_committed` counts it.
    """

    def __init__(
        self,
        path: Path | str,
        info: ScanInfo,
        frame_shape: tuple[int, int],
        *,
        clock: Clock,
        preview_bin: int = 4,
        flush_every: int = 1,
    ) -> None:
        """Create the file. DataError where it exists or cannot be made."""
        raise NotImplementedError

    def append(self, frame: Frame, digest: FrameDigest, flags: int = 0) -> None:
        """Write the next row; `frame.index` must be `committed`. `flags`: 32-bit mask of the monitor's checks.

        DataError for a wrong shape, type or index (nothing is written), or a disk that does not take it.
        """
        raise NotImplementedError

    @property
    def committed(self) -> int:
        """Frames that are complete in the file (flushed or not)."""
        raise NotImplementedError

    def close(self, status: str = "complete", missing: Sequence[int] = ()) -> None:
        """Finish: status ("complete", "stopped", "failed"), end time, missing triggers, then the /exchange view.

        `missing`: indices, counted over all triggers of the scan from 0, of those that gave no frame.
        """
        raise NotImplementedError

    def __enter__(self) -> Self:
        raise NotImplementedError

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        raise NotImplementedError
