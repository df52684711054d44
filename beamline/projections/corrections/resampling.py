"""Resampling: the tilt of the axis and the distortion of the lens are taken out of the views, in one step."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from beamline.core.errors import ConfigError
from beamline.core.files import text_in
from beamline.projections.protocols import ScanPart, ViewFilter
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from recon.prep import resample
    from recon.prep.correct import Projections

_MOST_TILT_DEG = 45.0


def _tilt(text: str) -> float | str:
    """An angle within 45 degrees, or "auto"."""
    if text == "auto":
        return text
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= _MOST_TILT_DEG:
        raise ValueError(f"{text!r} is neither auto nor degrees within {_MOST_TILT_DEG:g} of 0")
    return number


def _distortion(text: str) -> resample.Distortion:
    """The distortion that a text file says."""
    from recon.prep.resample import Distortion

    try:
        return Distortion.parse(text_in(Path(text)))
    except (OSError, ValueError) as error:
        raise ValueError(f"{text}: {error}") from error


@dataclass(frozen=True)
class TiltAndLens:
    """How views are resampled.

    Attributes:
        tilt: degrees by which the axis leans in the detector's plane; its column grows by tan(tilt) a row. "auto": it
            is found. None: it is unknown, and views are used as they are.
        distortion: of the lens; None: none.
    """

    name: ClassVar[str] = "tilt"
    follows: ClassVar[tuple[str, ...]] = ("noise",)
    tilt: float | str | None = option(
        "--tilt",
        None,
        "By how much the rotation axis leans in the detector's plane (its column grows with the rows): views are "
        "turned. auto finds it by all rows. Default: views are used as they are, with a warning if they show a tilt.",
        parse=_tilt,
        metavar="DEGREES|auto",
    )
    distortion: resample.Distortion | None = option(
        "--distortion",
        None,
        "Radial distortion of the lens, which is taken out of the views: the text file that discorpy writes "
        "(backward model: xcenter, ycenter, factor0 ...).",
        parse=_distortion,
        metavar="FILE",
        path=True,
    )

    @property
    def sought(self) -> bool:
        """The tilt is to be found."""
        return self.tilt == "auto"

    @property
    def tilt_deg(self) -> float:
        """The turn of the views in degrees, as far as it is known."""
        return self.tilt if isinstance(self.tilt, float | int) else 0.0

    @property
    def needs_finished(self) -> str:
        said = "--tilt auto is for a finished scan: it needs all views. Give it in degrees."
        return said if self.sought else ""

    def memory(self, part: ScanPart) -> StepMemory:
        from beamline.projections.tilt import search_memory
        from recon.prep.tilt import STEEPEST

        known = replace(self, tilt=math.degrees(STEEPEST)) if self.sought else self
        if (found := known.of(part.source, part.selection)) is None:
            return StepMemory()
        copies = 17 if self.distortion is None else 26
        search = search_memory(part.source, part.selection) if self.sought else 0
        return StepMemory(copies * part.view_bytes(found.reach), search)

    def on(self, source: ScanSource, selection: Selection) -> tuple[ViewFilter | None, StepDone]:
        found, turned = self.of(source, selection), f"Views are turned by {self.tilt_deg:g} degrees."
        if found is None:
            return None, self.done("")

        def apply(views: Projections, first: int) -> Projections:
            found.apply(views.data, first)
            return replace(views, masked=found.nearest(views.masked, first))

        return ViewFilter(apply, found.reach, "--tilt and --distortion mix"), self.done(turned if self.tilt_deg else "")

    def done(self, said: str) -> StepDone:
        """What it did, with what is recorded where nothing was asked, too."""
        lens = {} if self.distortion is None else asdict(self.distortion)
        parameters: dict[str, Any] = {"tilt_deg": self.tilt_deg, **({"tilt": said} if said else {})}
        return StepDone(said, parameters | {f"distortion_{name}": _plain(value) for name, value in lens.items()})

    def of(self, source: ScanSource, selection: Selection) -> resample.Resampling | None:
        """How views are resampled; None where they are used as they are.

        Raises:
            ConfigError: a cone's axis is to be levelled.
        """
        from beamline.projections.selection import cone_of
        from recon.prep.resample import Resampling

        if (self.tilt_deg or self.sought) and cone_of(source, selection) is not None:
            raise ConfigError(f"--tilt is for a parallel beam; {source.path} is a cone. Leave it out.")
        if not self.tilt_deg and self.distortion is None:
            return None
        lens = self.distortion
        if lens is not None and source.cols is not None:
            lens = replace(lens, col=lens.col - source.cols[0])
        return Resampling(source.shape, math.radians(self.tilt_deg), lens, selection.binning)


def _plain(value: Any) -> float | str:
    return value if isinstance(value, float) else str(value)
