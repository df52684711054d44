"""ViewRays: where the rays of each view run and the field that they see, by the convention of `recon.base.geometry`."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64, frozen
from recon.base.declared_types import check_settings
from recon.base.ray_width import NO_WIDTH, RayWidth

_OFF_MIDDLE = 0.05  # share of the detector's width; beyond it, a tenth of the field lies on one side only
_SHORT_OF_SOURCE = 0.7  # share of sod: the corners of a box of this half width do not reach the source


@dataclass(frozen=True, eq=False)
class ViewRays:
    """The values of a `Geometry`, which says what each attribute is, and what follows from them."""

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
                "centres need a cone beam whose stage does not turn during the exposure (no arc). Displace the views "
                "of a parallel beam by shifts"
            )
        if not math.isfinite(self.skew) or (self.skew and not (self.is_straight and not self.is_cone)):
            raise ValueError(
                f"skew must be finite, and 0 unless the beam is parallel and no view is rolled or tilted; got "
                f"{self.skew:.3g} rad a row"
            )

    @property
    def n_views(self) -> int:
        return int(self.angles.size)

    @property
    def is_cone(self) -> bool:
        return math.isfinite(self.sod)

    @property
    def is_straight(self) -> bool:
        """Rows run along u and columns along the rotation axis: no roll, tilt or centres (views may be shifted)."""
        return not (self.roll.any() or self.tilt.any() or self.centres.any())

    @property
    def rows_show_slices(self) -> bool:
        """Each detector row shows one slice in all views: a parallel beam, straight, not shifted along the axis."""
        return self.is_straight and not (self.is_cone or self.shifts[:, 1].any())

    @property
    def climbs(self) -> bool:
        """Whether views step along the rotation axis by half the detector's rows or more, as in a helix.

        By the middle half of them, which climbs half as far: single views that stand apart make no climb.
        """
        low, high = np.percentile(self.offsets[:, 1], (25, 75))
        return bool(4 * (high - low) >= self.detector_shape[0])

    @property
    def lean(self) -> float:
        """Largest displacement by roll and tilt, from row to row, of a point of the field: mm at the rotation axis."""
        across = np.abs(np.sin(self.roll)) + np.abs(np.sin(self.tilt))
        return self.reach * float(across.max())

    @property
    def period(self) -> float:
        """Angle, in radians, after which views repeat the same rays: π for a centred parallel beam, else 2π.

        2π holds for a cone, and for an axis that leans along the beam by more than half a pixel over the field. It also
        holds for an axis more than a tenth of the field off the detector's middle: views half a turn apart then see
        different parts.
        """
        leans = self.reach * float(np.abs(np.sin(self.tilt)).max()) > 0.5 * self.sample_pitch
        return 2 * math.pi if self.is_cone or leans or self.is_off_middle else math.pi

    @property
    def unseen_cone(self) -> float:
        """Half angle, in radians, of the cone of wave vectors about the rotation axis that no view measures.

        It is the least lean of the axis along the beam; 0 where that is at most half a pixel over the field.
        """
        least = float(np.abs(self.tilt).min())
        return least if self.reach * math.sin(least) > 0.5 * self.sample_pitch else 0.0

    @property
    def is_off_middle(self) -> bool:
        """Whether the axis stands off the detector's middle by more than a twentieth of its width: a wide field."""
        cols = self.detector_shape[1]
        axis = (self.axis_col + self.offsets[:, 0])[self.ordinary]
        return abs(float(axis.mean()) - (cols - 1) / 2) > _OFF_MIDDLE * cols

    @property
    def ordinary(self) -> NDArray[np.bool_]:
        """[view] which views are no wide views: those show the sample stepped aside by more than half a field."""
        aside = self.shifts[:, 0]
        usual = np.sort(aside)[(aside.size - 1) // 2]
        return np.asarray(np.abs(aside - usual) <= self.detector_shape[1] / 2)

    @property
    def offsets(self) -> F64:
        """Pixels (col, row) from (axis_col, axis_row) to the image of the object's origin, [view, 2]."""
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
        """mm from the rotation axis to the farthest column edge of any view, measured at the axis.

        Rolled views count as straight ones, wide views do not. For a wide cone the value is limited to 0.7 sod.
        """
        cols, axis = self.detector_shape[1], (self.axis_col + self.offsets[:, 0])[self.ordinary]
        reach = max(axis.max() + 0.5, cols - 0.5 - axis.min()) * self.sample_pitch
        return float(min(reach, _SHORT_OF_SOURCE * self.source_distance))

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest z in mm, at the rotation axis, that any view sees; tilted views count as straight ones."""
        rows, axis = self.detector_shape[0], self.axis_row + self.offsets[:, 1]
        low, high = -0.5 - axis.max(), rows - 0.5 - axis.min()
        return float(low * self.sample_pitch), float(high * self.sample_pitch)

    def axes(self, view: int) -> F64:
        """Unit vectors [3, 3] of one view in the object's frame: along the columns, along the rows, along the beam."""
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
        """Pixel (col, row) of the origin of the object's frame, or of the view's centre, in one view."""
        return self.axis_col + float(self.shifts[view, 0]), self.axis_row + float(self.shifts[view, 1])
