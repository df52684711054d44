"""Ray width: the size and blur of a detector pixel, and the rotation of the stage during an exposure and its
readout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from beamline.core.errors import ConfigError
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.protocols import ScanPart
from beamline.projections.registry import geometry_steps
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.selection import SelectedScan
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.recon_record import Value
    from recon.base.geometry import Geometry

_MOST_PX, _MOST_DEG = 20.0, 30.0  # largest values; beyond these a projection shows no detail
_LEAST_PX = 1.0  # px at the edge of the field of view; `auto` models a motion of at least this size


class _Motion(NamedTuple):
    """Rotation of the stage in radians during an exposure, and from the readout of one detector row to the next. Both
    have a sign.
    """

    arc: float
    skew: float


def _spread(text: str) -> str:
    """Parse the option: none, pixel, or a blur in pixels. Raises ValueError for anything else."""
    if text not in ("none", "pixel"):
        try:
            blur = float(text)
        except ValueError:
            blur = math.nan
        if not 0 < blur <= _MOST_PX:
            raise ValueError(
                f"{text!r} is unknown; expected none, pixel, or a blur of up to {_MOST_PX:g} pixels, e.g. 0.7"
            )
    return text


def _arc(text: str) -> str:
    """Parse the option: auto, none, or the degrees of rotation during the exposure, and from the readout of the first
    row to that of the last row. Raises ValueError for anything else.
    """
    if text not in ("auto", "none"):
        try:
            numbers = [float(part) for part in text.split(":")]
        except ValueError:
            numbers = []
        if not (0 < len(numbers) <= 2 and all(abs(number) <= _MOST_DEG for number in numbers) and numbers[0] >= 0):
            raise ValueError(
                f"{text!r} is unknown; expected auto, none, or ARC[:READOUT] of 0 to {_MOST_DEG:g} degrees, e.g. 0.5"
            )
    return text


@dataclass(frozen=True)
class Width:
    """Widths of the rays: the arc of an exposure, and the pixel.

    Attributes:
        spread: "none": thin rays. "pixel": the area of the pixel. A number: the area of the pixel, and a Gaussian blur
            of this many pixels.
        arc: "auto": the motion that the file states, if it is a pixel or more. "none": the stage stood still during
            exposures. "ARC[:READOUT]": degrees of rotation during an exposure, and from the first detector row to the
            last.
    """

    name: ClassVar[str] = "width"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase", "jumps")
    spread: str = option(
        "--ray-width",
        "none",
        "Width of the rays in the model. none: thin rays. pixel: the area of a pixel. SIGMA: the area of "
        "a pixel with a Gaussian blur of SIGMA pixels.",
        parse=_spread,
        metavar="none|pixel|SIGMA",
    )
    arc: str = option(
        "--exposure-arc",
        "auto",
        "Rotation of the stage in degrees: ARC during an exposure, READOUT between the readout of the first row and "
        "the readout of the last row (negative: the last row is read first). auto: from the file of a fly scan, if "
        "ARC is 1 px or more at the edge of the field of view. none: the stage does not turn during an exposure.",
        parse=_arc,
        metavar="auto|none|ARC[:READOUT]",
    )

    @property
    def needs_finished(self) -> str:
        if self.spread == "none" and self.arc in ("auto", "none"):
            return ""
        return "--ray-width and --exposure-arc need a finished scan"

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()

    def rays(self, scan: SelectedScan, geometry: Geometry) -> tuple[Geometry, StepDone]:
        """The geometry with the width of the rays. The angles become the angles in the middle of the exposure.

        Raises:
            ConfigError: a readout arc was given for a cone beam, or for projections that are or may be rolled or
                tilted. With a readout arc each detector row has other angles, which such geometries cannot represent.
        """
        from recon.base.ray_width import RayWidth

        source, selection = scan.source, scan.selection
        blur = 0.0 if self.spread in ("none", "pixel") else float(self.spread)
        width = RayWidth(0.0 if self.spread == "none" else 1.0, blur).binned(selection.binning)
        stated, motion = self._motion(source), _Motion(0.0, 0.0)
        if (table := stated_poses(scan)) is not None and table.vectors is not None:
            stated = None  # the angles of vectors are already those of the middle of the exposure
            if self.arc not in ("auto", "none"):
                raise ConfigError(
                    f"Omit --exposure-arc {self.arc}, because the projections are given by the vectors of "
                    f"{table.path}, which cannot describe a rotation during the exposure."
                )
        parameters: dict[str, Value] = {}
        reach_px, rows = geometry.reach / geometry.sample_pitch * selection.binning, source.shape[0]
        if stated is not None:
            tilted = not geometry.is_straight or any(step.may_roll_or_tilt for step in geometry_steps(selection))
            rows_differ = geometry.is_cone or tilted
            if self.arc != "auto":
                motion = stated
                if rows_differ and stated.skew:
                    obstacle = (
                        "the beam is a cone"
                        if geometry.is_cone
                        else "the projections are rolled or tilted, or will be calibrated for roll or tilt"
                    )
                    raise ConfigError(
                        f"Use --exposure-arc {self.arc.split(':')[0]} instead of {self.arc}: the readout arc (after "
                        f"the colon) needs a parallel beam without roll or tilt, but {obstacle}. Nothing was written."
                    )
            elif abs(stated.arc) * reach_px >= _LEAST_PX:
                motion = _Motion(stated.arc, 0.0 if rows_differ else stated.skew)
            # the arc is too short to be modelled, but the angles are still those of the middle of the exposure
            elif stated.arc:
                geometry = replace(geometry, angles=geometry.angles + stated.arc / 2)
                parameters["middle_of_exposure_deg"] = math.degrees(stated.arc / 2)
        if not (width or any(motion)):
            return geometry, StepDone(parameters=parameters)
        first_row = (selection.rows or (0, 0))[0] + (selection.binning - 1) / 2
        exposed_geometry = replace(geometry, angles=geometry.angles + motion.arc / 2 + motion.skew * first_row)
        exposed_geometry = exposed_geometry.seen_with(
            replace(width, arc=abs(motion.arc)), motion.skew * selection.binning
        )
        exposure_degrees, readout_degrees = math.degrees(abs(motion.arc)), math.degrees(motion.skew * (rows - 1))
        statements = [
            *([f"each ray has the area of a pixel{f' and a blur of {blur:g} px' if blur else ''}"] if width else []),
            *([f"a projection is the mean over {exposure_degrees:.3g} degrees ({abs(motion.arc) * reach_px:.2g} px at "
                "the edge of the field of view)"] if motion.arc else []),
            *([f"the last detector row is exposed {readout_degrees:.2g} degrees later than the first"]
              if motion.skew else []),
        ]  # fmt: skip
        parameters |= {
            "ray_width": self.spread, "exposure_arc_deg": math.degrees(motion.arc), "readout_arc_deg": readout_degrees,
        }  # fmt: skip
        return exposed_geometry, StepDone(f"Ray width in the reconstruction: {', '.join(statements)}.", parameters)

    def _motion(self, source: ScanSource) -> _Motion | None:
        """The motion that the user or the file states. None: the stage stood still, or the motion is not stated."""
        if self.arc == "none":
            return None
        if self.arc != "auto":
            arc, skew = ([math.radians(float(part)) for part in self.arc.split(":")] + [0.0])[:2]
            direction = -1.0 if _step(source.table.angles[source.table.views]) < 0 else 1.0
            return _Motion(direction * arc, direction * skew / max(source.shape[0] - 1, 1))
        return stated_motion(source)


def stated_motion(source: ScanSource) -> _Motion | None:
    """The motion in the file of a fly scan. None if the stage stood still, or if the file does not state it.

    The speed follows from the median step between projections, so passes and missing projections do not matter.
    """
    import numpy as np

    plan, period = source.plan, source.attributes.get("period_s")
    if not (plan.get("mode") == "fly" or plan.get("fly") is True) or not isinstance(period, float) or period <= 0:
        return None
    exposures = source.table.exposures[source.table.views]
    if not np.isfinite(exposures).any():
        return None
    speed = _step(source.table.angles[source.table.views]) / period
    return _Motion(speed * float(np.nanmedian(exposures)), speed * (source.row_period or 0.0))


def _step(angles: NDArray[np.float64]) -> float:
    """The median step between projections in radians."""
    import numpy as np

    steps = np.diff(angles)
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if steps.size else 0.0
