"""Geometry: the rays of all projections, as one immutable value.

Convention (fixed for the whole project): the object stands still, and the projection direction turns. For a projection
(view) at angle θ

    u = x cos θ + y sin θ        columns grow with u
    v = z                        rows grow with v (the rotation axis is z)
    rays run along d = (-sin θ, cos θ, 0)

Parallel beam: column i has its centre at u = (i - axis_col) * pixel_pitch, so `axis_col` counts pixels from 0 at the
centre of the first column. Row j has its centre at v = (j - axis_row) * pixel_pitch, with axis_row = (rows - 1) / 2 by
default.

Cone beam: the source lies at -sod * d, the detector sdd away from it. A point at depth w = sod + x·d falls on column
axis_col + (sdd / w) u / pixel_pitch and on row axis_row + (sdd / w) v / pixel_pitch, with pixel_pitch on the detector.

A real set-up may differ from this in three ways, each with a value for every projection. `tilt` tilts the rotation axis
along the beam (laminography), `roll` rotates the detector about the beam, `shifts` displace the image on the detector.
The sources of a cone may be anywhere: then `centres` displace the axes of a projection, and x - centre replaces x.
`recon.base.vectors` makes a geometry from vectors for each projection.

Two more values describe the exposure. `width` says over which rays a pixel averages, in addition to its central ray.
`skew` is the angle that the stage turns from the readout of one row to the next (rolling shutter): row j has the angle
θ + j skew.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import F64, frozen
from recon.base.declared_types import check_arguments, check_settings
from recon.base.greys import fan, html
from recon.base.placement import LONGEST, Where, checked_angles, placed_views
from recon.base.ray_width import NO_WIDTH, RayWidth

_OFF_MIDDLE = 0.05  # share of the detector's width; beyond it, a tenth of the field of view is on one side only
_SHORT_OF_SOURCE = 0.7  # share of sod; the corners of a box with this half width do not reach the source
_MAGNIFIED = 1e6  # far above any real one; a voxel stays in the range of float32
_OF_VIEWS = "angles", "shifts", "roll", "tilt", "centres"  # attributes that have one value for each projection


@dataclass(frozen=True, eq=False)
class Geometry:
    """Geometry of a set of projections; construct it with `Geometry.parallel`, `Geometry.cone` or `Geometry.fan`.

    Attributes:
        angles: float64 [view], radians, any order, any range.
        detector_shape: (rows, cols) in pixels.
        pixel_pitch: size of a detector pixel in mm, at the sample for a parallel beam, on the detector for a cone beam;
            1.0 for a parallel beam: all lengths are in pixels.
        axis_col, axis_row: column of the rotation axis, and row of the height z = 0 (for a cone beam: row that the
            central ray meets), in pixels of the detector, 0 at the centre of the first column or row.
        sod, sdd: mm from the source to the rotation axis and to the detector; both infinite for a parallel beam.
        shifts: float64 [view, 2], displacement of each projection in pixels (col, row).
        roll: float64 [view], radians; rotation of the detector about the beam, so that the column number grows along
            u cos(roll) + v sin(roll).
        tilt: float64 [view], radians; tilt of the rotation axis along the beam, so that the row number grows along
            v cos(tilt) + d sin(tilt), with d the direction of the beam.
        width: how wide rays are (see `RayWidth`); the same for all rays.
        skew: angle in radians by which the stage turns from the readout of one row to the next (parallel beam only);
            `angles` are the angles of the first row.
        centres: float64 [view, 3], (x, y, z) in mm (cone beam only): the point that lies at the distance `sod` from the
            source, along the beam of the projection; left out: the origin in all projections.
    """

    angles: F64
    detector_shape: tuple[int, int]
    pixel_pitch: float
    axis_col: float
    axis_row: float
    sod: float
    sdd: float
    shifts: F64
    roll: F64
    tilt: F64
    width: RayWidth = NO_WIDTH
    skew: float = 0.0
    centres: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.centres.any():
            object.__setattr__(self, "centres", frozen(np.zeros((self.angles.size, 3))))
        elif not self.is_cone or self.width.arc:
            raise ValueError(
                "centres need a cone beam, and a stage that does not turn during the exposure (no arc). For a "
                "parallel beam, give shifts instead"
            )
        if not math.isfinite(self.skew) or (self.skew and not (self.is_straight and not self.is_cone)):
            raise ValueError(
                "skew must be finite, and 0 for a cone beam or if a projection is rolled or tilted; got "
                f"{self.skew:.3g} rad per row"
            )

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
            where: the keyword arguments `axis_col`, `axis_row`, `shifts`, `roll` and `tilt`, see `Where`.

        Raises:
            ValueError: there are no angles, an angle is not finite, the detector is empty, or the pitch is not
                positive.
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
        """Cone beam from a point source to a flat detector. The source is `sod` mm from the rotation axis and `sdd` mm
        from the detector.

        Args:
            pixel_pitch: mm, in the plane of the detector; at the rotation axis a pixel is smaller by the factor sod /
                sdd.
            where: the keyword arguments `axis_col`, `axis_row`, `shifts`, `roll` and `tilt`, see `Where`.

        Raises:
            ValueError: as for `Geometry.parallel`; or a distance is not finite, or 0 < sod <= sdd is not true.
        """
        check_arguments(cls.cone, locals())
        if not 0 < sod <= sdd <= LONGEST or sdd > _MAGNIFIED * sod:
            raise ValueError(
                f"a cone beam needs finite distances with 0 < sod <= sdd in mm, got sod {sod} and sdd {sdd}. The "
                f"largest distance is {LONGEST:g} mm (beyond it, use a parallel beam), the largest magnification "
                f"{_MAGNIFIED:g}"
            )
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
        """Fan beam to a flat line of `cols` pixels: a cone beam with one detector row, in the plane of the source.

        Args:
            shifts: [view], pixels along the line.

        Raises:
            ValueError: for the same reasons as `Geometry.cone`, or `shifts` are not one number for each angle.
        """
        check_arguments(cls.fan, locals())
        if shifts is not None and np.shape(shifts) != np.shape(np.atleast_1d(angles)):
            raise ValueError(
                f"shifts must hold one number for each projection, shape [{np.size(angles)}], got shape "
                f"{np.shape(shifts)}"
            )
        moved = None if shifts is None else np.stack([np.asarray(shifts, np.float64), np.zeros(np.size(angles))], 1)
        return cls.cone(angles, (1, cols), pixel_pitch, sod, sdd, axis_col=axis_col, axis_row=0.0, shifts=moved)

    @property
    def n_views(self) -> int:
        return int(self.angles.size)

    @property
    def is_cone(self) -> bool:
        return math.isfinite(self.sod)

    @cached_property
    def is_fan(self) -> bool:
        """Whether the beam is a fan: one straight detector row in the plane that contains the source and is
        perpendicular to the axis."""
        level = self.detector_shape[0] == 1 and not (self.axis_row + self.shifts[:, 1]).any()
        return self.is_cone and self.is_straight and level

    @cached_property
    def is_straight(self) -> bool:
        """Whether roll, tilt and centres are all 0: detector rows run along u, and columns along the axis. (Shifts are
        allowed.)"""
        return not (self.roll.any() or self.tilt.any() or self.centres.any())

    @property
    def rows_show_slices(self) -> bool:
        """Whether each detector row shows the same slice in all projections: parallel beam, no roll or tilt, no shift
        along the axis."""
        return self.is_straight and not (self.is_cone or self.shifts[:, 1].any())

    @property
    def climbs(self) -> bool:
        """Whether the sample moves along the rotation axis by half the height of the detector or more, as in a helical
        scan.

        The highest and the lowest quarter of the positions are ignored, so that single displaced projections have no
        effect. In a helical scan, the other positions span half of the whole displacement along the axis.
        """
        low, high = np.percentile(self.offsets[:, 1], (25, 75))
        return bool(4 * (high - low) >= self.detector_shape[0])

    @property
    def lean(self) -> float:
        """Largest distance in mm, along the rotation axis, by which roll and tilt move a point in the field of view."""
        across = np.abs(np.sin(self.roll)) + np.abs(np.sin(self.tilt))
        return self.reach * float(across.max())

    @property
    def period(self) -> float:
        """Angle in radians after which projections repeat the same rays: π for a parallel beam with the axis in the
        middle, otherwise 2π.

        The period is 2π for a cone beam. The period is also 2π if the axis is tilted along the beam so much that the
        edge of the field of view moves by more than half a pixel. If the axis is off the detector's middle by more than
        a twentieth of the detector's width, the period is 2π, because opposite projections then see different parts of
        the sample.
        """
        leans = self.reach * float(np.abs(np.sin(self.tilt)).max()) > 0.5 * self.sample_pitch
        return 2 * math.pi if self.is_cone or leans or self.is_off_middle else math.pi

    @property
    def unseen_cone(self) -> float:
        """Half angle in radians of the cone about the rotation axis, in Fourier space, that no projection measures.

        The half angle equals the smallest tilt of the axis along the beam among all projections. The half angle counts
        as 0 if this tilt moves the edge of the field of view by at most half a pixel.
        """
        least = float(np.abs(self.tilt).min())
        return least if self.reach * math.sin(least) > 0.5 * self.sample_pitch else 0.0

    @property
    def is_off_middle(self) -> bool:
        """Whether the axis is off the detector's middle by more than a twentieth of the detector's width (half
        acquisition).
        """
        cols = self.detector_shape[1]
        axis = (self.axis_col + self.offsets[:, 0])[self.is_centred]
        return abs(float(axis.mean()) - (cols - 1) / 2) > _OFF_MIDDLE * cols

    @property
    def is_centred(self) -> NDArray[np.bool_]:
        """[view] False for a projection that is offset laterally by more than half the detector width, True for all
        others."""
        aside = self.shifts[:, 0]
        usual = np.sort(aside)[(aside.size - 1) // 2]
        return np.asarray(np.abs(aside - usual) <= self.detector_shape[1] / 2)

    @property
    def offsets(self) -> F64:
        """[view, 2] pixels (col, row): how far the image of the object's origin lies from (axis_col, axis_row)."""
        if not self.centres.any():
            return self.shifts
        u, v, w = np.einsum("vij,vj->iv", [self.axes(view) for view in range(self.n_views)], -self.centres)
        return np.asarray(self.shifts + np.stack((u, v), 1) * (self.sdd / (self.sod + w) / self.pixel_pitch)[:, None])

    @property
    def source_distance(self) -> float:
        """mm from the object's origin to the nearest source; infinite for a parallel beam."""
        if not self.centres.any():
            return self.sod
        beams = np.array([self.axes(view)[2] for view in range(self.n_views)])
        return float(np.linalg.norm(self.centres - self.sod * beams, axis=1).min())

    @property
    def middle_height(self) -> float:
        """z in mm of the middle of the detector's rows."""
        return ((self.detector_shape[0] - 1) / 2 - self.axis_row) * self.sample_pitch

    @property
    def sample_pitch(self) -> float:
        """Detector pixel in mm at the rotation axis."""
        return self.pixel_pitch * self.sod / self.sdd if self.is_cone else self.pixel_pitch

    @property
    def reach(self) -> float:
        """Radius of the field of view in mm: distance from the rotation axis to the farthest ray of any projection.

        The roll of the detector and laterally offset projections are ignored. For a wide cone, the distance is limited
        to 0.7 of the distance from the source to the rotation axis.
        """
        cols, axis = self.detector_shape[1], (self.axis_col + self.offsets[:, 0])[self.is_centred]
        reach = max(axis.max() + 0.5, cols - 0.5 - axis.min()) * self.sample_pitch
        return float(min(reach, _SHORT_OF_SOURCE * self.source_distance))

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest z in mm of the points on the rotation axis that any projection sees; tilt is ignored."""
        rows, axis = self.detector_shape[0], self.axis_row + self.offsets[:, 1]
        low, high = -0.5 - axis.max(), rows - 0.5 - axis.min()
        return float(low * self.sample_pitch), float(high * self.sample_pitch)

    def axes(self, view: int) -> F64:
        """Unit vectors [3, 3] of one projection in the object's frame: along columns, along rows, along the beam."""
        c, s = math.cos(self.angles[view]), math.sin(self.angles[view])
        ct, st = math.cos(self.tilt[view]), math.sin(self.tilt[view])
        cr, sr = math.cos(self.roll[view]), math.sin(self.roll[view])
        (u0, u1, u2), (v0, v1, v2) = (c, s, 0.0), (-s * st, c * st, ct)
        return np.array(
            (
                (cr * u0 + sr * v0, cr * u1 + sr * v1, cr * u2 + sr * v2),
                (cr * v0 - sr * u0, cr * v1 - sr * u1, cr * v2 - sr * u2),
                (-s * ct, c * ct, -st),
            )
        )

    def origin(self, view: int) -> tuple[float, float]:
        """Pixel (col, row) at which one projection shows the origin of the object's frame; if the geometry has
        `centres`, the pixel at which the projection shows its own centre."""
        return self.axis_col + float(self.shifts[view, 0]), self.axis_row + float(self.shifts[view, 1])

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
        """HTML for a notebook: the projection directions, and the position of the axis on the detector."""
        centre = (self.axis_col + 0.5) / self.detector_shape[1]
        return html("Geometry", fan(self.angles, centre), {"views": repr(self)[9:-1]})

    def select(self, views: Sequence[int] | NDArray[np.integer] | slice) -> Geometry:
        """The same geometry with only the projections `views`, in the order of `views`.

        Raises:
            ValueError: `views` is empty.
        """
        chosen = np.atleast_1d(np.arange(self.n_views)[views])
        if chosen.size == 0:
            raise ValueError("no projections are selected; select at least one projection")
        some: dict[str, Any] = {name: frozen(getattr(self, name)[chosen]) for name in _OF_VIEWS}
        return replace(self, **some)

    def at(self, angles: ArrayLike) -> Geometry:
        """The same set-up at other angles (radians). Shift, roll and tilt are kept; each must be the same in all
        projections.

        Raises:
            ValueError: there are no angles, an angle is not finite, or shift, roll, tilt or centre differ between
                projections, so that their values at a new angle are unknown.
        """
        for name in _OF_VIEWS[1:]:
            widest = float(np.ptp(getattr(self, name), axis=0).max())
            if widest > 0:
                raise ValueError(
                    f"{name} differ between the projections (by up to {widest:.3g}), so the values at other angles "
                    "are unknown. Use a geometry in which all projections have the same value, or one that contains "
                    "the other angles"
                )
        theta = frozen(checked_angles(angles))
        return replace(self.select(np.zeros(theta.size, np.int64)), angles=theta)

    def followed_by(self, other: Geometry) -> Geometry:
        """The projections of this geometry, followed by those of another geometry of the same set-up."""
        both: dict[str, Any] = {
            name: frozen(np.concatenate((getattr(self, name), getattr(other, name)))) for name in _OF_VIEWS
        }
        return replace(self, **both)

    def straightened(self) -> Geometry:
        """The same projections with roll, tilt and `centres` set to 0."""
        none = frozen(np.zeros(self.n_views))
        return replace(self, roll=none, tilt=none, centres=frozen(np.zeros((self.n_views, 3))))

    def scaled(self, factor: float) -> Geometry:
        """The same geometry with all lengths multiplied by `factor`, for example to change the unit."""
        lengths = {name: factor * getattr(self, name) for name in ("pixel_pitch", "sod", "sdd")}
        return replace(self, **lengths, centres=frozen(factor * self.centres))

    def seen_with(self, width: RayWidth, skew: float = 0.0) -> Geometry:
        """The same projections with the ray width `width` and the skew `skew` (see the attributes of `Geometry`).

        Raises:
            ValueError: the skew is not finite; or the skew is not 0 and the beam is a cone, or projections are rolled
                or tilted. (One detector row of a cone beam, or of a rolled or tilted detector, sees several slices.)
        """
        return replace(self, width=width, skew=float(skew))

    def about(self, centres: ArrayLike) -> Geometry:
        """The same projections of a cone beam with other `centres`, [view, 3] in mm (see the attribute).

        Raises:
            ValueError: the centres are not finite or have another shape, or the beam is parallel.
        """
        points = np.asarray(centres, np.float64)
        if points.shape != (self.n_views, 3) or not np.isfinite(points).all():
            raise ValueError(
                f"centres must be finite (x, y, z) in mm with shape [{self.n_views}, 3], got shape {points.shape}"
            )
        return replace(self, centres=frozen(points))

    def at_row(self, row: float) -> Geometry:
        """The same geometry without skew: every row has the angle of row `row`."""
        return replace(self, angles=frozen(self.angles + row * self.skew), skew=0.0) if self.skew else self

    def rows(self, start: int, stop: int) -> Geometry:
        """The same geometry for detector rows start..stop.

        For a parallel beam without roll and tilt, z = 0 moves to the middle of the detector rows start..stop, so that a
        slab can be treated as a separate scan. For a cone beam, and for rolled or tilted projections, the central ray
        and the point about which projections are rolled and tilted stay at z = 0.
        """
        rows = self.detector_shape[0]
        if not 0 <= start < stop <= rows:
            raise ValueError(f"rows {start}:{stop} are outside the detector, which has rows 0:{rows}")
        off_middle = self.axis_row - (rows - 1) / 2
        keeps = self.is_cone or not self.is_straight
        axis_row = self.axis_row - start if keeps else off_middle + (stop - start - 1) / 2
        cropped = replace(self, detector_shape=(stop - start, self.detector_shape[1]), axis_row=axis_row)
        return replace(cropped, angles=frozen(self.angles + start * self.skew)) if start * self.skew else cropped

    def binned(self, factor: int) -> Geometry:
        """The geometry after binning by factor x factor; trailing rows and columns that do not fill a bin are dropped.

        For a parallel beam without roll and tilt, z = 0 moves to the middle of the remaining rows, as in
        `Geometry.rows`.
        """
        if operator.index(factor) < 1:
            raise ValueError(f"the bin factor must be 1 or more, got {factor}")
        rows, cols = (n // factor for n in self.detector_shape)
        if rows < 1 or cols < 1:
            raise ValueError(f"the bin factor {factor} is larger than the detector, {self.detector_shape} (rows, cols)")
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
    """A message if the rotation axis is outside the detector in all projections; empty text if a projection shows the
    axis.

    If no projection shows the axis, the region around it is not measured, and the field of view is a ring.
    """
    axes = np.atleast_1d(np.asarray(axis_cols, np.float64))
    sentence = (
        f"The rotation axis, column {axes[0]:g}, is outside the detector's columns 0 to {cols - 1}, so no projection "
        "shows the sample near the axis. Columns count from 0 at the centre of the first column of the given images. "
        "For cropped images, subtract the columns that were cropped before the axis; for binned images, give the "
        "axis in binned columns."
    )
    return "" if ((axes >= -0.5) & (axes <= cols - 0.5)).any() else sentence


def require_views(geometry: Geometry, values: ArrayLike, name: str = "projections") -> None:
    """Raise ValueError unless the values have the shape [view, row, col] of the geometry."""
    if (shape := np.shape(values)) != (expected := (geometry.n_views, *geometry.detector_shape)):
        raise ValueError(f"{name} must have shape {expected} [view, row, col] to match the geometry, got {shape}")


def arrays_of(geometry: Geometry) -> dict[str, NDArray[Any]]:
    """All values of a geometry as arrays, by name."""
    values = {each.name: getattr(geometry, each.name) for each in fields(Geometry)}
    return {name: np.asarray(astuple(v) if isinstance(v, RayWidth) else v) for name, v in values.items()}
