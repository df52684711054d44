"""Geometry: the rays of every view, as one immutable value.

Convention (fixed for the whole project): the object stands still and the view turns. For a view at angle θ

    u = x cos θ + y sin θ        columns grow with u
    v = z                        rows grow with v (the rotation axis is z)
    rays run along d = (-sin θ, cos θ, 0)

Parallel beam: column i has its centre at u = (i - axis_col) * pixel_pitch, so `axis_col` counts pixels from 0 at the
centre of the first column. Row j has its centre at v = (j - axis_row) * pixel_pitch, with axis_row = (rows - 1) / 2 by
default.

Cone beam: the source lies at -sod * d, the detector sdd away from it. A point at depth w = sod + x·d falls on column
axis_col + (sdd / w) u / pixel_pitch and on row axis_row + (sdd / w) v / pixel_pitch, with pixel_pitch on the detector.

A real set-up departs from this in three ways, each given for every view. `tilt` leans the rotation axis along the beam
(laminography), `roll` turns the detector about the beam, `shifts` displace the image on the detector. The sources of a
cone may stand anywhere: then `centres` displace the view's axes, and x - centre takes the place of x.
`recon.base.vectors` makes a geometry of vectors of each view.

Two more follow from the exposure. `width` says what a pixel sees beside its central ray. `skew` says how far the stage
turns from the readout of one row to the next (rolling shutter): row j sees the angle θ + j skew.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import frozen
from recon.base.declared_types import check_arguments
from recon.base.greys import fan, html
from recon.base.placement import Where, checked_angles, placed_views
from recon.base.ray_width import RayWidth
from recon.base.view_rays import ViewRays

_OF_VIEWS = "angles", "shifts", "roll", "tilt", "centres"  # attributes with one value for each view


@dataclass(frozen=True, eq=False)
class Geometry(ViewRays):
    """Geometry of a set of views; construct it with `Geometry.parallel`, `Geometry.cone` or `Geometry.fan`.

    Attributes:
        angles: float64 [view], radians, any order, any range.
        detector_shape: (rows, cols) in pixels.
        pixel_pitch: detector pixel in mm: at the sample for a parallel beam (1.0 = work in pixels), on the detector
            for a cone.
        axis_col, axis_row: where the rotation axis and the height z = 0 fall on the detector (a cone: its central ray).
            In pixels from 0 at the centre of the first column, row.
        sod, sdd: mm from the source to the rotation axis and to the detector; both infinite for a parallel beam.
        shifts: float64 [view, 2], displacement of each view in pixels (col, row).
        roll: float64 [view], radians; the detector turned about the beam: its columns run along u cos + v sin.
        tilt: float64 [view], radians; the rotation axis leaning along the beam: rows then run along v cos + d sin.
        width: of every ray; see `seen_with`.
        skew: radians from one row to the next, of a parallel beam; `angles` are those of the first row.
        centres: float64 [view, 3], (x, y, z) in mm, of a cone: the point that stands `sod` behind the source along the
            view's beam. Left out: the origin.
    """

    @classmethod
    def parallel(
        cls,
        angles: ArrayLike,
        detector_shape: tuple[int, int],
        *,
        pixel_pitch: float = 1.0,
        **where: Unpack[Where],
    ) -> Geometry:
        """Parallel beam.

        Args:
            where: `axis_col`, `axis_row`, `shifts`, `roll` and `tilt` by keyword, see `Where`.

        Raises:
            ValueError: for no views, non-finite angles, an empty detector, or a pitch that is not positive.
        """
        check_arguments(cls.parallel, locals())
        return cls(**placed_views(angles, detector_shape, pixel_pitch, **where), sod=math.inf, sdd=math.inf)

    @classmethod
    def cone(
        cls,
        angles: ArrayLike,
        detector_shape: tuple[int, int],
        pixel_pitch: float,
        sod: float,
        sdd: float,
        **where: Unpack[Where],
    ) -> Geometry:
        """Cone beam from a point `sod` mm before the rotation axis onto a flat detector `sdd` mm behind the source.

        Args:
            pixel_pitch: mm, in the plane of the detector; at the rotation axis a pixel is sod / sdd of it.
            where: `axis_col`, `axis_row`, `shifts`, `roll` and `tilt` by keyword, see `Where`.

        Raises:
            ValueError: as `parallel`, and for distances that are not finite with 0 < sod <= sdd.
        """
        check_arguments(cls.cone, locals())
        if not (math.isfinite(sod) and math.isfinite(sdd) and 0 < sod <= sdd):
            raise ValueError(f"a cone beam needs finite distances with 0 < sod <= sdd in mm, got {sod} and {sdd}")
        return cls(**placed_views(angles, detector_shape, pixel_pitch, **where), sod=float(sod), sdd=float(sdd))

    @classmethod
    def fan(
        cls,
        angles: ArrayLike,
        cols: int,
        pixel_pitch: float,
        sod: float,
        sdd: float,
        *,
        axis_col: float | None = None,
        shifts: ArrayLike | None = None,
    ) -> Geometry:
        """Fan beam onto a flat line of `cols` pixels: a cone of one row, in the plane of the source.

        Args:
            shifts: [view], pixels along the line.

        Raises:
            ValueError: as `cone`.
        """
        check_arguments(cls.fan, locals())
        if shifts is not None and np.shape(shifts) != np.shape(np.atleast_1d(angles)):
            raise ValueError(f"shifts must be one number a view [{np.size(angles)}], got shape {np.shape(shifts)}")
        moved = None if shifts is None else np.stack([np.asarray(shifts, np.float64), np.zeros(np.size(angles))], 1)
        return cls.cone(angles, (1, cols), pixel_pitch, sod, sdd, axis_col=axis_col, axis_row=0.0, shifts=moved)

    def __repr__(self) -> str:
        low, high = np.rad2deg((self.angles.min(), self.angles.max()))
        beam = f"cone {self.sod:.6g}:{self.sdd:.6g}" if self.is_cone else "parallel"
        moved = [name for name in ("shifts", "roll", "tilt", "centres") if getattr(self, name).any()]
        moved += [name for name in ("width", "skew") if getattr(self, name)]
        return (
            f"Geometry({beam}, {self.n_views} views from {low:.4g} to {high:.4g} degrees, detector "
            f"{self.detector_shape[0]} x {self.detector_shape[1]}, pitch {self.pixel_pitch:.4g}, axis_col "
            f"{self.axis_col:.6g}{''.join(f', with {name}' for name in moved)})"
        )

    def _repr_html_(self) -> str:
        """For a notebook: directions of the views, and where the axis falls on the detector."""
        centre = (self.axis_col + 0.5) / self.detector_shape[1]
        return html("Geometry", fan(self.angles, centre), {"views": repr(self)[9:-1]})

    def select(self, views: Sequence[int] | NDArray[np.integer] | slice) -> Geometry:
        """The same geometry with only `views`, in that order.

        Raises:
            ValueError: for no views.
        """
        chosen = np.atleast_1d(np.arange(self.n_views)[views])
        if chosen.size == 0:
            raise ValueError("no views are selected")
        some: dict[str, Any] = {name: frozen(getattr(self, name)[chosen]) for name in _OF_VIEWS}
        return replace(self, **some)

    def at(self, angles: ArrayLike) -> Geometry:
        """The same set-up at other angles (radians), with the shift, roll and tilt common to all views.

        Raises:
            ValueError: for bad angles, or if shift, roll, tilt or centre differ between views: new ones are not known.
        """
        for name in _OF_VIEWS[1:]:
            widest = float(np.ptp(getattr(self, name), axis=0).max())
            if widest > 0:
                raise ValueError(
                    f"{name} differ from view to view (by up to {widest:.3g}), so those at other angles are not "
                    f"known. Give a geometry whose views share one value, or one that holds the other views"
                )
        theta = frozen(checked_angles(angles))
        return replace(self.select(np.zeros(theta.size, np.int64)), angles=theta)

    def followed_by(self, other: Geometry) -> Geometry:
        """The views of this geometry, then those of another one of the same set-up."""
        both: dict[str, Any] = {
            name: frozen(np.concatenate((getattr(self, name), getattr(other, name)))) for name in _OF_VIEWS
        }
        return replace(self, **both)

    def straightened(self) -> Geometry:
        """The same views without roll, tilt and centres."""
        none = frozen(np.zeros(self.n_views))
        return replace(self, roll=none, tilt=none, centres=frozen(np.zeros((self.n_views, 3))))

    def scaled(self, factor: float) -> Geometry:
        """The same geometry with all lengths multiplied by `factor`, as in another unit."""
        lengths = {name: factor * getattr(self, name) for name in ("pixel_pitch", "sod", "sdd")}
        return replace(self, **lengths, centres=frozen(factor * self.centres))

    def seen_with(self, width: RayWidth, skew: float = 0.0) -> Geometry:
        """The same views with rays of a width, and a skew from row to row (rolling shutter).

        Raises:
            ValueError: a skew that is not finite, or of a cone, or of rolled or tilted views: slices of the volume then
                belong to no row.
        """
        return replace(self, width=width, skew=float(skew))

    def about(self, centres: ArrayLike) -> Geometry:
        """The same views of a cone with other centres, [view, 3] in mm; see `centres`.

        Raises:
            ValueError: not finite, another shape, or of a parallel beam.
        """
        points = np.asarray(centres, np.float64)
        if points.shape != (self.n_views, 3) or not np.isfinite(points).all():
            raise ValueError(f"centres must be finite mm (x, y, z) [{self.n_views}, 3], got shape {points.shape}")
        return replace(self, centres=frozen(points))

    def at_row(self, row: float) -> Geometry:
        """The same geometry without skew: all rows at the angle of this one."""
        return replace(self, angles=frozen(self.angles + row * self.skew), skew=0.0) if self.skew else self

    def rows(self, start: int, stop: int) -> Geometry:
        """The same geometry for detector rows start..stop.

        For a parallel beam v is then measured from the middle of these rows, so that a slab is a scan of its own. The
        central ray of a cone keeps its place, and so does the point that views are rolled and tilted about.
        """
        rows = self.detector_shape[0]
        if not 0 <= start < stop <= rows:
            raise ValueError(f"rows {start}:{stop} do not lie in 0:{rows}")
        off_middle = self.axis_row - (rows - 1) / 2
        keeps = self.is_cone or not self.is_straight
        axis_row = self.axis_row - start if keeps else off_middle + (stop - start - 1) / 2
        cropped = replace(self, detector_shape=(stop - start, self.detector_shape[1]), axis_row=axis_row)
        return replace(cropped, angles=frozen(self.angles + start * self.skew)) if start * self.skew else cropped

    def binned(self, factor: int) -> Geometry:
        """The geometry after binning by factor x factor; trailing rows and columns that do not fill a bin are dropped.

        As with `rows`, v of a straight parallel beam is then measured from the middle of the rows left.
        """
        if operator.index(factor) < 1:
            raise ValueError(f"bin factor must be >= 1, got {factor}")
        rows, cols = (n // factor for n in self.detector_shape)
        if rows < 1 or cols < 1:
            raise ValueError(f"bin factor {factor} is larger than the detector {self.detector_shape}")
        whole = self.rows(0, rows * factor)
        return replace(
            whole,
            detector_shape=(rows, cols),
            pixel_pitch=self.pixel_pitch * factor,
            axis_col=(whole.axis_col - (factor - 1) / 2) / factor,
            axis_row=(whole.axis_row - (factor - 1) / 2) / factor,
            shifts=frozen(self.shifts / factor),
            angles=frozen(whole.angles + (factor - 1) / 2 * self.skew),
            width=self.width.binned(factor),
            skew=self.skew * factor,
        )


def unseen_axis(axis_cols: ArrayLike, cols: int) -> str:
    """The sentence on a rotation axis outside the detector's columns in all views; empty where a view shows it.

    Without any view of it, what lies about the axis is not measured, and the field is a ring of any size.
    """
    axes = np.atleast_1d(np.asarray(axis_cols, np.float64))
    sentence = (
        f"The rotation axis, column {axes[0]:g}, lies outside the detector's columns 0 to {cols - 1}: no view shows "
        "what lies about it. Columns count from 0 at the centre of the first column that was given: of a cropped or "
        "binned detector, give the axis less the columns cropped before it, in binned columns."
    )
    return "" if ((axes >= -0.5) & (axes <= cols - 0.5)).any() else sentence


def require_views(geometry: Geometry, values: ArrayLike, name: str = "projections") -> None:
    """Raise ValueError unless the values are [view, row, col] of the geometry's views."""
    if (shape := np.shape(values)) != (expected := (geometry.n_views, *geometry.detector_shape)):
        raise ValueError(f"{name} have shape {shape}, the geometry says {expected} [view, row, col]")


def arrays_of(geometry: Geometry) -> dict[str, NDArray[Any]]:
    """All values of a geometry as arrays, by name; `geometry_of_arrays` is the inverse."""
    values = {each.name: getattr(geometry, each.name) for each in fields(Geometry)}
    return {name: np.asarray(astuple(v) if isinstance(v, RayWidth) else v) for name, v in values.items()}


def geometry_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> Geometry:
    """The geometry with the values that `arrays_of` gives."""
    values: dict[str, Any] = {name: array.item() if array.ndim == 0 else array for name, array in arrays.items()}
    rows, cols = values.pop("detector_shape").tolist()
    width = RayWidth(*values.pop("width").tolist())
    return Geometry(detector_shape=(rows, cols), width=width, **values)
