"""Small scans with a known answer: two cylinders along the rotation axis, projected with exact chords."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.storage.recorded_frames import record_checksums
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from recon.base.volume import Grid

DARK, BEAM = 100.0, 20000.0
# (x, y, radius, attenuation) in pixels and 1/pixel; the second cylinder is inside the first and adds to it.
CYLINDERS = ((0.0, 0.0, 13.0, 0.02), (5.0, 3.0, 3.0, 0.05))


@dataclass(frozen=True)
class TwoCylinders:
    """The scan: angles [view] in radians, (rows, cols), axis_col, pixel size in mm."""

    angles: NDArray[np.float64] = field(default_factory=lambda: np.radians(np.arange(0, 180, 4.0)))
    shape: tuple[int, int] = (4, 40)
    axis_col: float = 20.7
    pixel_size_mm: float = 1.0

    def line_integrals(self) -> NDArray[np.float64]:
        """[view, row, col], dimensionless, averaged over the width of each pixel."""
        sub = (np.arange(8) + 0.5) / 8 - 0.5
        u = (np.arange(self.shape[1])[:, None] + sub - self.axis_col)[None]
        total = np.zeros((self.angles.size, self.shape[1]))
        for x, y, radius, mu in CYLINDERS:
            centre = x * np.cos(self.angles) + y * np.sin(self.angles)
            half = np.sqrt(np.clip(radius**2 - (u - centre[:, None, None]) ** 2, 0, None))
            total += (2 * mu * half).mean(axis=2)
        return np.repeat(total[:, None, :], self.shape[0], axis=1)

    def counts(self, beam: float = BEAM) -> NDArray[np.uint16]:
        """Beer-Lambert, without noise."""
        return np.round(DARK + beam * np.exp(-self.line_integrals())).astype(np.uint16)

    def truth(self, grid: Grid) -> NDArray[np.float32]:
        """Attenuation [z, y, x] in 1/mm on a grid in mm."""
        _, y, x = grid.coordinates()
        sub = ((np.arange(6) + 0.5) / 6 - 0.5) * grid.voxel_size
        xs, ys = (x[:, None] + sub)[None, :, None, :], (y[:, None] + sub)[:, None, :, None]
        plane = np.zeros((y.size, x.size))
        for x0, y0, radius, mu in CYLINDERS:
            s = self.pixel_size_mm
            inside = (xs - x0 * s) ** 2 + (ys - y0 * s) ** 2 <= (radius * s) ** 2
            plane += mu / s * inside.mean(axis=(2, 3))
        return np.repeat(plane[None], grid.shape[0], axis=0).astype(np.float32)


def write_exchange(path: Path, scan: TwoCylinders, changes: Mapping[str, Any] | None = None) -> Path:
    """The scan as Data Exchange; `changes` replaces datasets of /exchange, None leaves one out."""
    flat = np.full((2, *scan.shape), DARK + BEAM, np.uint16)
    parts: dict[str, Any] = {
        "data": scan.counts(),
        "data_white": flat,
        "data_dark": np.full((2, *scan.shape), DARK, np.uint16),
        "theta": np.degrees(scan.angles),
        **(changes or {}),
    }
    with h5py.File(path, "w") as file:
        file["implements"] = "exchange"
        file.attrs["pixel_size_mm"] = scan.pixel_size_mm
        for name, data in parts.items():
            if data is not None:
                file[f"exchange/{name}"] = data
        if "exchange/theta" in file:
            file["exchange/theta"].attrs["units"] = "deg"
    return path


def write_nxtomo(path: Path, frames: NDArray[Any], keys: Any, degrees: Any) -> Path:
    """Frames of these image keys and angles as NXtomo, as other systems write it."""
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"], detector["image_key"] = frames, keys
        file["entry/sample/rotation_angle"] = degrees
        file["entry/sample/rotation_angle"].attrs["units"] = "deg"
    return path


def frames_of(scan: TwoCylinders, *, time: float = 1.8e9, period: float = 0.1) -> list[Frame]:
    """Two darks, two flats, then the projections, as a camera delivers them."""
    return frames_through(scan.counts(), scan.angles, time=time, period=period)


def frames_through(
    counts: NDArray[Any], angles: NDArray[np.float64], *, beam: float = BEAM, time: float = 1.8e9, period: float = 0.1
) -> list[Frame]:
    """Two darks, two flats, then these projections [view, row, col]."""
    last = np.zeros(counts.shape[1:])
    last[-1, -1] = 1.0  # no camera takes the same image twice
    images = [np.full(last.shape, level) + bump for level in (DARK, DARK + beam) for bump in (0.0, last)]
    kinds = [FrameKind.DARK] * 2 + [FrameKind.FLAT] * 2 + [FrameKind.PROJECTION] * len(counts)
    return [
        Frame(image.round().astype(np.uint16), kind, i, i, i, angle, time + period * i, 0.05)
        for i, (image, kind, angle) in enumerate(
            zip([*images, *counts], kinds, [np.nan] * 4 + angles.tolist(), strict=True)
        )
    ]


def seal(file: h5py.File) -> None:
    """Recompute the checksums of the rows of our scan file, so that changed columns count as written."""
    with suppress(ValueError):  # a column of another length, which the readers refuse
        columns = {path: file[path][()] for path in layout.RECORDED}
        file[layout.RECORD_CHECKSUM][...] = record_checksums(columns)


def write_flagged(
    path: Path,
    frames: list[Frame],
    levels: Mapping[int, Level],
    pixel_size_mm: float = 1.0,
    flags: Sequence[Flag] = (),
    energy_kev: float | None = None,
) -> Path:
    """Write the frames as our scan file, with flags of the monitor's first check at these levels, or with `flags`."""
    with NXtomoWriter(
        path,
        ScanInfo("flagged", pixel_size_mm=pixel_size_mm, energy_kev=energy_kev),
        frames[0].counts.shape,
        clock=SystemClock(),
    ) as writer:
        for frame in frames:
            said = (
                [Flag(CHECKS[0].name, levels[frame.index], frame.index, 1.0, 0.0, "")] if frame.index in levels else []
            )
            writer.append(frame, digest(frame.counts), said + [flag for flag in flags if flag.frame == frame.index])
    return path
