"""Resampling: corrects the in-plane tilt of the axis and the distortion of the lens with a single interpolation of the
projections.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import ScanPart, ViewFilter, ViewStep
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.core.sinks import Warn
    from beamline.projections.tilt import BandsDone
    from recon.prep import resample
    from recon.prep.projections import Projections

_MOST_TILT_DEG = 45.0
# number of bands of rows, rows of each band, and number of projections that --tilt auto uses
_BANDS, _BAND_ROWS, _VIEWS = 16, 4, 240
_NEGLIGIBLE_PX = 0.05  # px over the rows: a smaller tilt is not worth an interpolation
_ROUNDS = 5
_COPIES = 20  # number of float32 copies of all bands while their axes are searched for


def _tilt(text: str) -> float | str:
    """Parse the option: an angle within 45 degrees, or "auto"."""
    if text == "auto":
        return text
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= _MOST_TILT_DEG:
        raise ValueError(f"{text!r} is wrong; expected auto, or degrees within {_MOST_TILT_DEG:g} of 0")
    return number


def _distortion(text: str) -> resample.Distortion:
    """The distortion that a text file states."""
    from recon.prep.resample import Distortion

    try:
        return Distortion.parse(text_in(Path(text)))
    except OSError as error:
        raise ValueError(f"{text}: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from error


@dataclass(frozen=True)
class TiltAndLens:
    """Settings of the resampling of projections: tilt and lens distortion.

    Attributes:
        tilt: tilt of the axis in the plane of the detector, in degrees; the column of the axis grows by tan(tilt) per
            row. "auto": the tilt is measured. None: the tilt is unknown, and projections are used unchanged.
        distortion: distortion of the lens; None: no correction.
    """

    name: ClassVar[str] = "tilt"
    follows: ClassVar[tuple[str, ...]] = ("preparation",)
    tilt: float | str | None = option(
        "--tilt",
        None,
        "In-plane tilt of the rotation axis in degrees, positive if the column of the axis grows from the first "
        "row to the last; projections are rotated by this angle. auto: find it from all rows. Default: use "
        "projections as they are, with a warning if they show a tilt.",
        parse=_tilt,
        metavar="DEGREES|auto",
    )
    distortion: resample.Distortion | None = option(
        "--distortion",
        None,
        "Correct the radial distortion of the lens with FILE, the text file that discorpy writes "
        "(backward model: xcenter, ycenter, factor0 ...).",
        parse=_distortion,
        metavar="FILE",
        path=True,
    )

    @property
    def sought(self) -> bool:
        """True if the tilt is to be found from the projections."""
        return self.tilt == "auto"

    @property
    def tilt_deg(self) -> float:
        """The known roll of the projections in degrees."""
        return self.tilt if isinstance(self.tilt, float | int) else 0.0

    @property
    def needs_finished(self) -> str:
        sentence = "--tilt auto needs a finished scan, because it uses all projections. Give the tilt in degrees."
        return sentence if self.sought else ""

    def memory(self, part: ScanPart) -> StepMemory:
        from recon.prep.tilt import STEEPEST

        steepest_step = replace(self, tilt=math.degrees(STEEPEST)) if self.sought else self
        if (steepest := steepest_step.of(part.scan)) is None:
            return StepMemory()
        copies = 17 if self.distortion is None else 26
        search = _search_memory(part.scan) if self.sought else 0
        return StepMemory(copies * part.view_bytes(steepest.reach), search)

    def on(self, scan: SelectedScan) -> tuple[ViewFilter | None, StepDone]:
        resampling = self.of(scan)
        if resampling is None:
            return None, self.done("")

        def apply(views: Projections, first: int) -> Projections:
            resampling.apply(views.data, first)
            return replace(views, masked=resampling.nearest(views.masked, first))

        turned = f"The projections are rotated by {self.tilt_deg:g} degrees." if self.tilt_deg else ""
        return ViewFilter(apply, resampling.reach, "--tilt and --distortion mix"), self.done(turned)

    def done(self, sentence: str) -> StepDone:
        """What the step did. It is also recorded if nothing was requested."""
        parameters: dict[str, Any] = {"tilt_deg": self.tilt_deg, **({"tilt": sentence} if sentence else {})}
        for name, value in ({} if self.distortion is None else asdict(self.distortion)).items():
            parameters[f"distortion_{name}"] = value if isinstance(value, float) else str(value)
        return StepDone(sentence, parameters)

    def of(self, scan: SelectedScan) -> resample.Resampling | None:
        """The resampling of the projections; None if the projections are used as they were recorded.

        Raises:
            ConfigError: --tilt was given for a cone beam.
        """
        from recon.prep.resample import Resampling

        source, selection = scan.source, scan.selection
        if (self.tilt_deg or self.sought) and selection.cone is not None:
            raise ConfigError(
                f"Omit --tilt: this option is for a parallel beam, and {source.path} is a cone-beam scan."
            )
        if not self.tilt_deg and self.distortion is None:
            return None
        lens = self.distortion
        if lens is not None and source.cols is not None:
            lens = replace(lens, col=lens.col - source.cols[0])
        return Resampling(source.shape, math.radians(self.tilt_deg), lens, selection.binning)


def with_tilt(
    scan: SelectedScan, frames: NDArray[np.int64], warn: Warn, progress: BandsDone
) -> tuple[SelectedScan, dict[str, StepDone]]:
    """The scan with the tilt that was found from all detector rows, if the user requested it. Also what was done, by
    the name of the step.

    Args:
        frames: projections that may be used.
        progress: function that gets the number of bands of rows that were corrected, and their largest number.

    Raises:
        ConfigError: the scan has a cone beam.
        DataError: the projections do not determine the tilt.
    """
    from beamline.projections.tilt import MATTERS, tilt_text
    from recon.base.views import spread_views
    from recon.prep.tilt import STEEPEST

    step, source = scan.selection.step(TiltAndLens), scan.source
    step.of(scan)  # raises an error for a cone beam
    if not step.sought:
        return scan, {}
    rows, frames = source.shape[0] // scan.selection.binning, spread_views(source.table.angles[frames], _VIEWS, frames)
    try:
        tilt, uncertainty = _refined(scan.part(rows=None), frames, progress)
    except ValueError as error:
        raise DataError(
            f"{source.path}: the tilt of the axis was not found: {error}. Give the tilt with --tilt DEGREES, or omit "
            "--tilt."
        ) from error
    if abs(tilt) > STEEPEST:
        raise DataError(
            f"Check the projections of {source.path}: the axis seems to be tilted by "
            f"{math.degrees(tilt):.1f} degrees, and at most {math.degrees(STEEPEST):g} are searched. Give "
            "the tilt with --tilt DEGREES."
        )
    offset_px = abs(tilt) * rows
    tilt_sentence = f"The axis is tilted by {tilt_text(tilt, uncertainty)}, {offset_px:.2g} px over {rows} rows"
    if uncertainty * rows > MATTERS:
        warn(
            "Check the first and the last slices for double edges: the tilt is so uncertain that the axis may shift by "
            f"more than {MATTERS:g} pixels from the first to the last row. {tilt_sentence}."
        )
    negligible = abs(tilt) < 2 * uncertainty or abs(tilt) * rows < _NEGLIGIBLE_PX
    step = replace(step, tilt=0.0 if negligible else math.degrees(tilt))
    done = step.done(
        f"{tilt_sentence}; not corrected."
        if negligible
        else f"{tilt_sentence}; the projections are rotated to correct it."
    )
    return scan.with_steps(step), {step.name: done}


def _search_memory(scan: SelectedScan) -> int:
    """Largest memory in bytes that `with_tilt` needs if it measures the tilt."""
    from beamline.projections.correction import at_once_memory
    from recon.prep.tilt import STEEPEST

    source, binning, step = scan.source, scan.selection.binning, scan.selection.step(TiltAndLens)
    steepest = _without_blur(scan).part(rows=None).with_steps(replace(step, tilt=math.degrees(STEEPEST)))
    n, cols = min(source.table.views.size, _VIEWS), source.shape[1] // binning
    rows = source.shape[0] // binning
    middle = max(0, rows // 2 - _BAND_ROWS)
    band = at_once_memory(steepest, n, slice(middle, min(rows, middle + _BAND_ROWS)))
    return 4 * n * _BANDS * cols + max(band, _COPIES * 4 * n * _BANDS * cols)


def _refined(scan: SelectedScan, frames: NDArray[np.int64], progress: BandsDone) -> tuple[float, float]:
    """The tilt and its uncertainty in radians, measured in projections that were corrected by the tilt of the last
    round.

    Raises:
        ValueError: see `find_tilt`.
    """
    from beamline.projections.correction import survey
    from beamline.projections.tilt import shown_tilt

    unblurred, step = _without_blur(scan), scan.selection.step(TiltAndLens)
    rows = scan.source.shape[0] / scan.selection.binning
    tilt = 0.0
    for n in range(_ROUNDS):
        levelled = survey(unblurred.with_steps(replace(step, tilt=math.degrees(tilt))), frames)
        residual = shown_tilt(
            levelled, frames, (_BANDS, _BAND_ROWS), _part_of_progress(n * _BANDS, _ROUNDS * _BANDS, progress)
        )
        tilt += residual.tilt
        if abs(residual.tilt) < residual.uncertainty / 4 or abs(residual.tilt) * rows < _NEGLIGIBLE_PX / 2:
            break
    return tilt, residual.uncertainty


def _without_blur(scan: SelectedScan) -> SelectedScan:
    """The scan without other filters of the projections, because each filter mixes neighbouring pixels."""
    selection = scan.selection
    steps_without_blur = tuple(
        step for step in selection.steps if isinstance(step, TiltAndLens) or not isinstance(step, ViewStep)
    )
    logarithms = replace(selection.step(Preparation), noise="log", gain=None)
    return scan.part(steps=steps_without_blur).with_steps(logarithms)


def _part_of_progress(offset: int, total: int, progress: BandsDone) -> BandsDone:
    """Report the progress of a part of the work that begins at `offset`."""
    return lambda n, _: progress(offset + n, total)
