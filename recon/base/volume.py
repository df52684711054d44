"""Grid, Volume and VolumeSeries: a box of voxels in the object's frame, and the attenuation in its voxels."""

from __future__ import annotations

import math
import operator
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.declared_types import check_arguments, check_settings, refusal
from recon.base.geometry import Geometry
from recon.base.greys import html, middle_slices

COARSEST = 4.0
"""Largest voxel edge of a fit, in pixels. With coarser voxels, a fit would start from a blurred sample (not
measured)."""


@dataclass(frozen=True)
class Grid:
    """A box of voxels; voxel [k, j, i] has its centre at centre + ((i, j, k) - (n - 1) / 2) * edge.

    Attributes:
        shape: (nz, ny, nx) in voxels; z runs along the rotation axis.
        voxel_size: edge in mm along x and y, and along z if there is no slice_pitch.
        centre: (z, y, x) of the box's centre in mm; the rotation axis is x = y = 0.
        slice_pitch: edge in mm along z; None: voxels are cubes.
    """

    shape: tuple[int, int, int]
    voxel_size: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slice_pitch: float | None = None

    def __post_init__(self) -> None:
        check_settings(self)
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise ValueError(f"grid shape must be (nz, ny, nx) >= 1, got {self.shape}")
        for name, edge in (("voxel_size", self.voxel_size), ("slice_pitch", self.spacing[0])):
            if not (np.isfinite(edge) and edge > 0):
                raise ValueError(f"{name} must be a positive length in mm, got {edge}")
        if len(self.centre) != 3 or not np.isfinite(self.centre).all():
            raise ValueError(f"centre must be three finite lengths (z, y, x) in mm, got {self.centre}")
        # a shape given as a list or an array makes an equal grid
        object.__setattr__(self, "shape", tuple(operator.index(n) for n in self.shape))
        object.__setattr__(self, "centre", tuple(float(c) for c in self.centre))

    @classmethod
    def matching(cls, geometry: Geometry) -> Grid:
        """The grid with one voxel per detector pixel: (rows, cols, cols) voxels around the rotation axis. The middle
        slice is at the height of the middle detector row.

        If projections are shifted, not all of them see every position along the columns or rows. Let n be the largest
        number of projections that see one position. The grid covers all positions that at least n / 2 projections see.
        Therefore small alignment shifts do not change the grid, and the grid of a scan that steps up and down covers
        all heights.

        If the axis is off the detector's middle (`Geometry.is_off_middle`), the box contains the field of view of a
        360° scan, as in `of_field`. With a smaller box, material that projections see outside the box would appear in
        the voxels of the box.
        """
        check_arguments(cls.matching, locals())
        across, (down, middle) = _spread(geometry, 0)[0], _spread(geometry, 1)
        if geometry.is_off_middle:
            across = max(across, cls.of_field(geometry, geometry.sample_pitch).shape[1])
        height = geometry.middle_height + middle * geometry.sample_pitch
        return cls((down, across, across), geometry.sample_pitch, (height, 0.0, 0.0))

    @classmethod
    def of_field(cls, geometry: Geometry, voxel_size: float) -> Grid:
        """A box around the rotation axis that contains everything that any projection sees, for any axis position.

        The box includes every point that a projection shows, also if projections are shifted. The axis may be outside
        the detector. Roll and tilt are ignored. The field of view of a cone is measured at the
        rotation axis. Few projections see material outside the field of view, because such material is in the beam only
        at angles at which it is far from the source. The box of a wide cone ends before it reaches the source.
        """
        low, high = geometry.heights
        across, along = 2 * geometry.reach / voxel_size, (high - low) / voxel_size
        nx, nz = (max(1, math.ceil(n - 1e-6)) for n in (across, along))  # a rounding error adds no voxel
        if geometry.is_cone:  # the corners plus half a voxel must not reach the source
            nx = max(1, min(nx, math.floor(math.sqrt(2) * geometry.source_distance / voxel_size - 1 - 1e-6)))
        return cls((nz, nx, nx), voxel_size, ((low + high) / 2, 0.0, 0.0))

    @classmethod
    def for_fit(cls, geometry: Geometry, wanted: Grid, *, wider: bool = False) -> Grid:
        """The box that a Gaussian fit covers: the whole field of view, in voxels of the size of the grid `wanted`. If
        `wider` is True (for a sample that is wider than the field of view), the box is at least as wide as the grid
        `wanted`.

        The voxel size of a fit is between one and four pixels. Projections resolve nothing finer than a pixel, and a
        fit cannot start from a volume coarser than four pixels.
        """
        pixel = geometry.sample_pitch
        edge = min(max(wanted.voxel_size, pixel), COARSEST * pixel)
        field = cls.of_field(geometry, edge)
        return field.reaching(float(np.abs(wanted.edges[:, :2]).max()), geometry) if wider else field

    def widened(self, by: float, geometry: Geometry) -> Grid:
        """The box of the field of view, widened by the factor `by`.

        For a cone beam, the width is limited so that the corners of the box do not reach the source.
        """
        nz, nx, _ = self.shape
        most = math.sqrt(2) * geometry.source_distance / self.voxel_size - 1 - 1e-6
        across = max(nx, math.floor(min(by * nx, most)))
        return replace(self, shape=(nz, across, across))

    def reaching(self, radius: float, geometry: Geometry) -> Grid:
        """A wider box: voxels are added on all four sides until each side is `radius` mm from the rotation axis.

        For a cone beam, the box is limited so that the corners of the box do not reach the source.
        """
        most = geometry.source_distance / math.sqrt(2) - self.voxel_size
        half = np.asarray(self.shape[1:]) * self.voxel_size / 2
        below, above = (
            np.maximum(
                np.ceil((min(radius, most) - half + side * np.asarray(self.centre[1:])) / self.voxel_size - 1e-6), 0
            )
            for side in (1, -1)
        )
        y, x = (np.asarray(self.shape[1:]) + below + above).astype(int).tolist()
        middle = np.asarray(self.centre[1:]) + (above - below) / 2 * self.voxel_size
        return replace(self, shape=(self.shape[0], y, x), centre=(self.centre[0], *middle.tolist()))

    def as_tall_as_rays(self, geometry: Geometry) -> Grid:
        """A taller box: slices are added at the top and at the bottom until the box contains every ray of a cone beam.
        The extra slices are needed because the rays rise or fall on their way to the corners of the box.
        """
        corner, edge = float(np.hypot(*np.abs(self.edges[:, :2]).max(axis=0))), self.spacing[0]
        # how far the rays of a row rise over this distance
        row = min(corner / geometry.source_distance, 1.0) * geometry.sample_pitch
        (low, high), (bottom, top) = geometry.heights, self.edges[:, 2]
        axis = geometry.axis_row + geometry.shifts[:, 1]  # rays rise from their source, which moves with `centres`
        first, last = abs(-0.5 - axis.max()), abs(geometry.detector_shape[0] - 0.5 - axis.min())
        wanted = bottom - low + row * first, high + row * last - top
        below, above = (max(0, math.ceil(each / edge - 1e-6)) for each in wanted)
        centre = (self.centre[0] + (above - below) / 2 * edge, *self.centre[1:])
        return replace(self, shape=(below + self.shape[0] + above, *self.shape[1:]), centre=centre)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Voxel edges (z, y, x) in mm."""
        return (self.voxel_size if self.slice_pitch is None else self.slice_pitch, self.voxel_size, self.voxel_size)

    @property
    def edges(self) -> NDArray[np.float64]:
        """Lower and upper corner of the box, [2, 3] mm, each (x, y, z)."""
        half = np.asarray(self.shape[::-1]) * np.asarray(self.spacing[::-1]) / 2
        middle = np.asarray(self.centre[::-1])
        return np.stack((middle - half, middle + half))

    @property
    def first(self) -> tuple[float, float, float]:
        """Centre (z, y, x) of voxel [0, 0, 0] in mm."""
        z, y, x = (c - (n - 1) / 2 * edge for n, c, edge in zip(self.shape, self.centre, self.spacing, strict=True))
        return z, y, x

    def part(self, z: slice, y: slice, x: slice) -> Grid:
        """The part of this box in the slices z, y and x of its voxels. Each slice must have a start and a stop."""
        slices = (z, y, x)
        centre = tuple(
            first + (part.start + part.stop - 1) / 2 * edge
            for first, part, edge in zip(self.first, slices, self.spacing, strict=True)
        )
        nz, ny, nx = (part.stop - part.start for part in slices)
        return replace(self, shape=(nz, ny, nx), centre=centre)

    def coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Voxel centres along each axis: (z [nz], y [ny], x [nx]) in mm."""
        return tuple(  # type: ignore[return-value]
            c + (np.arange(n) - (n - 1) / 2) * edge
            for n, c, edge in zip(self.shape, self.centre, self.spacing, strict=True)
        )


def _spread(geometry: Geometry, axis: int) -> tuple[int, float]:
    """Extent in pixels that shifted projections see along columns (0) or rows (1), and the distance of the middle of
    this extent.

    The distance is from the middle of an unshifted projection. Positions count only if at least half as many
    projections see them as see the most frequently seen position. If projections move along the axis by half the
    detector's rows or more, all positions are kept.
    """
    size = geometry.detector_shape[1 - axis]
    first = -geometry.offsets[:, axis]
    edges = np.unique(np.concatenate((first, first + size)))
    within = (edges[:-1] + edges[1:]) / 2
    covered = (first[:, None] <= within) & (within < first[:, None] + size)
    enough = np.flatnonzero(2 * covered.sum(axis=0) >= covered.sum(axis=0).max())
    if axis == 1 and geometry.climbs:
        enough = np.flatnonzero(covered.any(axis=0))
    low, high = float(edges[enough[0]]), float(edges[enough[-1] + 1])
    return max(1, round(high - low)), (low + high - size) / 2


@dataclass(frozen=True, eq=False)
class Volume:
    """Attenuation on a grid. `data` is float32 [z, y, x] in 1/mm (1/pixel if the pitch is 1)."""

    data: NDArray[np.float32]
    grid: Grid

    def __post_init__(self) -> None:
        if not isinstance(self.grid, Grid):
            raise ValueError(refusal("grid", self.grid, Grid))
        # shape of an array, or of a dataset that is read slice by slice along z
        shape = getattr(self.data, "shape", None)
        if shape != self.grid.shape:
            raise ValueError(
                f"data must be an array with the shape of its grid, {self.grid.shape} [z, y, x], got {shape}"
            )

    def __repr__(self) -> str:
        size, edge = " x ".join(map(str, self.grid.shape)), self.grid.voxel_size
        return f"Volume({size} voxels [z, y, x] of {edge:.4g})"

    def save(self, path: str | Path, **facts: object) -> None:
        """Write the volume to the new file `path`, an .npz; `beamline export` converts it.

        The file contains the arrays `volume` float32 [z, y, x] in 1/mm, `voxel_mm`, `slice_mm` (the edge along z),
        `centre_zyx_mm`, and each value of `facts` under its name. The file is written completely or not at all.

        Raises:
            ValueError: the suffix is not .npz.
            FileExistsError: the file exists; it is not overwritten.
        """
        check_arguments(self.save, {"path": path})
        path, grid = Path(path), self.grid
        if path.suffix != ".npz":
            raise ValueError(
                f"save() writes .npz files only, got {str(path)!r}. Use `beamline export` for other formats"
            )
        if os.path.lexists(path):
            raise FileExistsError(f"{path} already exists, and save() does not overwrite files; give another name")
        partial = path.with_name(f".{path.name}.partial.npz")
        places: dict[str, object] = {
            "voxel_mm": grid.voxel_size, "slice_mm": grid.spacing[0], "centre_zyx_mm": grid.centre
        }  # fmt: skip
        try:
            np.savez(partial, **{"volume": self.data, **places, **facts})  # type: ignore[arg-type]
            partial.rename(path)
        finally:
            partial.unlink(missing_ok=True)

    def _repr_html_(self) -> str:
        """HTML for a notebook: the middle slices across z, y and x."""
        pixels, (low, high) = middle_slices(self.data)
        z, y, x = (n // 2 for n in self.grid.shape)
        shown = f"z = {z}, y = {y}, x = {x}; black {low:.4g}, white {high:.4g}"
        return html("Volume", pixels, {"voxels": repr(self)[7:-1], "slices": shown})


@dataclass(frozen=True, eq=False)
class VolumeSeries:
    """Volumes of a changing sample at several times, reconstructed together from all projections.

    Attributes:
        seconds: float64 [volume], time from the first projection in s.
        data: float32 [volume, z, y, x], or a dataset of a file.
        residual: each projection is compared with the projection of its mixture of volumes; the difference is divided
            by the projections (root mean squares). NaN if the series was read from a file; the metrics in the file then
            contain the residual.
    """

    seconds: NDArray[np.float64]
    data: Any
    residual: float = math.nan

    @property
    def n(self) -> int:
        """Number of volumes."""
        return len(self.seconds)

    @property
    def labels(self) -> tuple[str, ...]:
        """A short label for each volume: its time."""
        return tuple(f"{at:.4g} s" for at in self.seconds)

    def each(self) -> list[Any]:
        """The volumes. If the data are in a file, a volume reads its voxels only when it is sliced along z."""
        return [_VolumeAt(self.data, index) for index in range(self.n)]


class _VolumeAt:
    """One volume of a dataset [time, z, y, x], as a dataset [z, y, x] that is read in slices along z."""

    def __init__(self, data: Any, index: int) -> None:
        self._data, self._at, self.shape, self.dtype = data, index, data.shape[1:], data.dtype

    def __getitem__(self, z: slice) -> NDArray[np.float32]:
        return np.asarray(self._data[self._at, z])
