"""Benchmark of the density in scans over a part of the turn, and in scans that lost projections at one place.

python -m tests.bench.part_turns [--columns 128] [--methods NAME ...] [--beams NAME ...] prints a table with a row for
each scan and method: how far the mean density of each of two known bodies is from the true one, in per cent, and what
`recon.reconstruct` warned of.

The bodies are a cylinder of 0.72 of the detector's width (1.1 with half acquisition, where the axis is near an edge of
the detector), and a ball in it off the rotation axis. The simulator's projector computes exact chord lengths, 2 x 2
rays a pixel, which no method uses. A mean is taken over the voxels that are further than three voxels from every
surface, and from the ends of a cone.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

F32 = NDArray[np.float32]
METHODS = ["fbp", "fista-tv", "auto", "r2"]
BEAMS = "parallel", "axis off", "half acquisition", "cone"
TURNS = 180, 200, 240, 270, 300, 340, 360
_RADIUS, _WIDE = 0.36, 0.55  # of the cylinder in widths of the detector
_OFF = {"axis off": 0.1, "half acquisition": 0.3}  # axis from the middle of the detector, in widths of it
_MATRIX, _CONTRAST = 2.0, 1.0  # densities per width
_BALL, _AT = 0.1, (0.17, 0.1)  # radius and (x, y) of the ball in widths of the detector
_MARGIN = 3.0  # voxels


class Scan(NamedTuple):
    """Degrees over which projections are taken, and the degrees of those that were lost."""

    turn: float
    lost: tuple[float, float] | None = None

    @property
    def degrees(self) -> NDArray[np.float64]:
        """Angles of the projections: one and a half a degree."""
        every = np.arange(0, self.turn - 1e-9, 2 / 3)
        return every if self.lost is None else every[(every < self.lost[0]) | (every >= self.lost[1])]

    def __str__(self) -> str:
        return (
            f"{self.turn:g}°" if self.lost is None else f"{self.turn:g}° without {self.lost[0]:g} to {self.lost[1]:g}°"
        )


SCANS = [Scan(turn) for turn in TURNS] + [Scan(turn, (0.4 * turn, 0.5 * turn)) for turn in TURNS]


def radius_in(beam: str) -> float:
    """Radius of the cylinder in widths of the detector."""
    return _WIDE if beam == "half acquisition" else _RADIUS


def sample(beam: str, pitch: float, cols: int, rows: int) -> Phantom:
    """The cylinder and the ball, for a detector with so many pixels of this width at the sample."""
    field = cols * pitch
    cylinder = Cylinder(radius_in(beam) * field, 2 * rows * pitch, _MATRIX / field)
    ball = Ellipsoid((_BALL * field,) * 3, _CONTRAST / field, (_AT[0] * field, _AT[1] * field, 0.0))
    return Phantom.of([cylinder, ball])


def geometry_of(scan: Scan, beam: str, cols: int) -> Geometry:
    """The geometry of a scan with a quarter as many rows as columns, or half as many in a cone."""
    angles = np.radians(scan.degrees)
    if beam == "cone":
        return Geometry.cone(angles, (cols // 2, cols), 1.5 / cols, sod=4.0, sdd=6.0)
    axis = (cols - 1) / 2 - _OFF.get(beam, 0.0) * cols
    return Geometry.parallel(angles, (cols // 4, cols), pixel_pitch=1 / cols, axis_col=axis)


def projections(phantom: Phantom, geometry: Geometry) -> F32:
    """Line integrals [view, row, col], means of 2 x 2 rays a pixel."""
    rows, cols = geometry.detector_shape
    axis = 2 * geometry.axis_col + 0.5, 2 * geometry.axis_row + 0.5
    detector = Detector((2 * rows, 2 * cols), geometry.sample_pitch / 2, *axis, geometry.sod)
    views = [phantom.line_integrals(float(a), detector).reshape(rows, 2, cols, 2) for a in geometry.angles]
    return np.stack([view.mean(axis=(1, 3)) for view in views]).astype(np.float32)


def bodies(grid: Grid, beam: str, pitch: float, cols: int) -> Mapping[str, tuple[NDArray[np.bool_], float]]:
    """Voxels well inside the cylinder and the ball, and the true density there."""
    field, margin = cols * pitch, _MARGIN * grid.voxel_size
    z, y, x = (
        axis.reshape(shape) for axis, shape in zip(grid.coordinates(), ((-1, 1, 1), (-1, 1), (-1,)), strict=True)
    )
    from_ball = np.sqrt((x - _AT[0] * field) ** 2 + (y - _AT[1] * field) ** 2 + z**2) - _BALL * field
    high = np.abs(z) <= (0.25 * grid.shape[0] * grid.voxel_size if beam == "cone" else np.inf)
    inside = (np.hypot(x, y) < radius_in(beam) * field - margin) & high
    return {
        "cylinder": (inside & (from_ball > margin), _MATRIX / field),
        "ball": (inside & (from_ball < -margin), (_MATRIX + _CONTRAST) / field),
    }


class Errors(NamedTuple):
    """Errors of the mean densities as shares of the true ones, and the warnings."""

    cylinder: float
    ball: float
    method: str
    told: tuple[str, ...]


def errors(scan: Scan, beam: str, method: str, cols: int) -> Errors:
    """The errors of one volume. ValueError if the method cannot use the scan."""
    geometry = geometry_of(scan, beam, cols)
    data = projections(sample(beam, geometry.sample_pitch, cols, geometry.detector_shape[0]), geometry)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = recon.reconstruct(data, geometry, method)
    volume = result.volume
    shares = {
        name: float(volume.data[mask].mean(dtype=np.float64) / true - 1)
        for name, (mask, true) in bodies(volume.grid, beam, geometry.sample_pitch, cols).items()
    }
    return Errors(**shares, method=result.method, told=tuple(str(each.message) for each in caught))


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--columns", type=int, default=128)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--beams", nargs="+", default=BEAMS)
    asked = parser.parse_args(arguments)
    print("| beam | scan | method | cylinder (%) | ball (%) | told |\n" + "|---" * 6 + "|")
    for beam in asked.beams:
        for scan in SCANS:
            for method in asked.methods:
                try:
                    made = errors(scan, beam, method, asked.columns)
                except ValueError as error:
                    print(f"| {beam} | {scan} | {method} | | | refused: {error} |", flush=True)
                    continue
                name = method if made.method == method else f"{method} ({made.method})"
                print(f"| {beam} | {scan} | {name} | {100 * made.cylinder:+.2f} | {100 * made.ball:+.2f} "
                      f"| {'; '.join(made.told)} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
