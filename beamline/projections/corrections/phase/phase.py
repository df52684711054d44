"""Phase retrieval of a scan: chooses the filter from material, energy and distance, as the file and the options
state them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

from beamline.core.errors import ConfigError
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import ScanPart, ViewFilter
from beamline.projections.step import StepDone, StepMemory, option, positive

if TYPE_CHECKING:
    from beamline.projections.selection import SelectedScan
    from beamline.storage.readers.base import ScanSource
    from recon.base.geometry import Geometry
    from recon.features.phase import Paganin
    from recon.prep.projections import Projections

_AUTO = "auto"
_NO_FILTER = (
    "To apply a phase filter, give --phase paganin:RATIO (delta/beta). --phase auto found no filter: either no "
    "filter improves the prediction of held-out projections, or the scan has fewer than 16 projections."
)


def _material(text: str) -> str | None:
    """Parse the option: the part after `paganin:`, or "auto"; None for "none"."""
    filter_name, _, material = text.partition(":")
    if text not in ("none", _AUTO) and (filter_name != "paganin" or not material):
        raise ValueError(f"{text!r} is unknown; expected auto, none, paganin:RATIO (delta/beta) or paganin:MATERIAL")
    return _AUTO if text == _AUTO else material or None


def _unsharp(text: str) -> tuple[float, float]:
    """Parse the option `sigma:weight`."""
    try:
        sigma, weight = (float(part) for part in text.split(":"))
    except ValueError:
        sigma = weight = math.nan
    if not (0 < sigma < math.inf and 0 <= weight < math.inf):
        raise ValueError(f"{text!r} is wrong; expected SIGMA:WEIGHT with SIGMA > 0 in pixels, e.g. 1.5:2")
    return sigma, weight


@dataclass(frozen=True)
class Phase:
    """Settings of the phase retrieval.

    Attributes:
        material: the ratio of delta to beta, or a material, as the user gave it; "auto": the filter is chosen from
            the projections if the outer edges of the sample overshoot; None: no phase retrieval.
        distance_mm: distance from the sample to the detector; None: the value in the file.
        energy_kev: photon energy; None: the value in the file.
        unsharp: (sigma in pixels as they are used, weight), see `recon.features.phase.Paganin`; None: none.
        length: length of the filter that was found from the projections, in pixels as they are used; None: no filter
            was found, or none was searched for.
        explanation: what the projections show; empty: they show nothing certain.
    """

    name: ClassVar[str] = "phase"
    follows: ClassVar[tuple[str, ...]] = ("tilt",)
    needs_finished: ClassVar[str] = ""
    material: str | None = option(
        "--phase",
        _AUTO,
        "Phase retrieval from one distance (Paganin). X is the ratio delta/beta, or a material: a chemical formula, "
        "or a material of the simulator. none: no filter. auto: a filter is applied only if the outer edges of the "
        "sample show phase fringes. With auto, held-out projections determine the length of the filter. With "
        "paganin:X, the length follows from delta/beta and the distance.",
        parse=_material,
        metavar="auto|none|paganin:X",
    )
    distance_mm: float | None = option(
        "--distance-mm",
        None,
        "For --phase: distance in mm from the sample to the detector. Default: the value in the scan file.",
        parse=positive,
        metavar="MM",
    )
    energy_kev: float | None = option(
        "--energy-kev",
        None,
        "For --phase: photon energy in keV. Default: the value in the scan file.",
        parse=positive,
        metavar="KEV",
    )
    unsharp: tuple[float, float] | None = option(
        "--unsharp",
        None,
        "For --phase: after the phase filter, apply an unsharp mask, which restores fine detail; SIGMA is in pixels.",
        parse=_unsharp,
        metavar="SIGMA:WEIGHT",
    )

    length: float | None = field(default=None, compare=False)
    explanation: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        others = self.distance_mm, self.energy_kev, self.unsharp
        if self.material is None and any(other is not None for other in others):
            raise ValueError("--distance-mm, --energy-kev and --unsharp need --phase.")
        if (ratio := self._ratio) is not None and not 0 <= ratio < math.inf:
            raise ValueError(f"--phase: delta/beta must be 0 or more, got {self.material}.")

    @property
    def _ratio(self) -> float | None:
        """Delta over beta, if the user gave it as a number."""
        try:
            return float(self.material or "")
        except ValueError:
            return None

    def delta_beta(self, energy_kev: float) -> float:
        """The ratio of delta to beta. Raises ValueError for an unknown material."""
        if (ratio := self._ratio) is not None:
            return ratio
        from recon.prep.matter import delta_beta

        return delta_beta(str(self.material), energy_kev)

    def memory(self, part: ScanPart) -> StepMemory:
        from recon.features.phase import TRIAL_COPIES, TRIAL_ROWS, Paganin

        if self.material is None:
            return StepMemory()
        searches, cols = self.material == _AUTO, part.geometry.detector_shape[1]
        paganin = Paganin(1.0) if searches else self.filter_of(part.scan)[0]
        search = 4 * TRIAL_ROWS * cols * TRIAL_COPIES * (part.geometry.n_views + cols) if searches else 0
        return StepMemory((7 if self.unsharp is None else 9) * part.view_bytes(paganin.reach), search)

    def estimated(
        self, scan: SelectedScan, views: Projections, geometry: Geometry, progress: Callable[[int, int], None]
    ) -> Phase | None:
        """This step with the filter that these projections show. None if the user stated the filter, or if the
        projections show nothing certain.
        """
        from recon.features.phase import LEAST_DROP, length_by_held_out_views
        from recon.prep.overshoot import Overshoot

        undistorted = geometry.is_straight and not geometry.shifts.any() and scan.source.row_pitch_mm is None
        searches = self.material == _AUTO and self.length is None and views.weights is None and undistorted
        if not searches or not (overshoot := Overshoot.of(views.data)).certain:
            return None
        floor = scan.selection.step(Preparation).floor
        filter = length_by_held_out_views(views.data, geometry, floor, ~views.masked, progress)
        if filter is None:
            return replace(self, explanation=f"{overshoot.in_words()} {_NO_FILTER}")
        if filter.residual_drop < LEAST_DROP:
            reason = (
                f"No phase filter was applied. A filter over {filter.length:.3g} pixels would lower the residual "
                f"in held-out projections by {filter.residual_drop:.0%}. Because a filter blurs cracks, it is applied "
                f"by default only if it lowers this residual by at least {LEAST_DROP:.0%}. To apply a filter, give "
                "--phase paganin:RATIO."
            )
            return replace(self, explanation=f"{overshoot.in_words()} {reason}")
        relative_error = filter.factor - 1
        reason = (
            "A phase filter was applied, because it lowers the residual in held-out projections by "
            f"{filter.residual_drop:.0%}. The held-out projections determine the square of the filter's length to "
            f"within {relative_error:.0%}. --phase none omits the filter."
        )
        return replace(self, length=filter.length, explanation=f"{overshoot.in_words()} {reason}")

    def on(self, scan: SelectedScan) -> tuple[ViewFilter | None, StepDone]:
        if self.material is None or (self.material == _AUTO and self.length is None):
            reason = self.explanation or (
                self.unsharp and "--unsharp has no effect without a phase filter; give --phase paganin:RATIO."
            )
            return None, StepDone(f"No phase retrieval. {reason}" if reason else "", {"phase": "not retrieved"})
        paganin, sentence = self.filter_of(scan)

        def apply(views: Projections, first: int) -> Projections:
            paganin.retrieve(views.data, scan.selection.step(Preparation).floor)
            return views

        return ViewFilter(apply, paganin.reach, "--phase mixes"), StepDone(sentence, {"phase": sentence})

    def filter_of(self, scan: SelectedScan) -> tuple[Paganin, str]:
        """The phase filter for pixels of the selection, and a sentence about it.

        Raises:
            ConfigError: the distance, the energy or the pixel size is unknown, or the resulting filter is wider than
                the frame.
        """
        from recon.features.phase import Paganin, length_of

        source, selection = scan.source, scan.selection
        if source.row_pitch_mm is not None:
            raise ConfigError(f"--phase needs square pixels; the pixels of {source.path} are not square.")
        cone, pitch = selection.cone, selection.pixel_size_mm
        energy = source.energy_kev if self.energy_kev is None else self.energy_kev
        distance = self.distance_mm
        if distance is None:
            distance = _stated_distance(source) if cone is None else cone[1] - cone[0] or None
        values = {"--distance-mm": distance, "--energy-kev": energy, "--pixel-size-um": pitch}
        missing = [option for option, value in values.items() if value is None]
        if missing and self.length is None:
            missing_values = " and ".join(missing)
            raise ConfigError(f"--phase needs {missing_values}, which {source.path} does not state.")
        length, sentence = self.length or 0.0, "from held-out projections"
        if not missing:
            assert distance is not None and energy is not None and pitch is not None
            fresnel_factor, pitch_factor = (
                (1.0, 1.0) if cone is None else (cone[0] / (cone[0] + distance), cone[0] / cone[1])
            )
            unit = length_of(1.0, distance * fresnel_factor, energy, pitch * pitch_factor * selection.binning)
            try:
                ratio = self.delta_beta(energy) if self.length is None else (self.length / unit) ** 2
            except ValueError as error:
                raise ConfigError(f"--phase paganin:{self.material}: {error}") from error
            sentence = f"delta/beta {ratio:.4g} at {energy:g} keV, {distance:g} mm behind the sample"
            length = math.sqrt(ratio) * unit
        paganin = Paganin(length, self.unsharp)
        if paganin.length > max(source.shape) / selection.binning:
            n_rows = source.shape[0]
            n_cols = source.shape[1]
            raise ConfigError(
                f"Check ratio, energy (keV) and distance (mm) of --phase: {sentence}, gives a filter over "
                f"{paganin.length:.4g} pixels, but {source.path} has only {n_rows} x {n_cols} pixels."
            )
        mask = "" if paganin.unsharp is None else "; unsharp mask of {:g} px by {:g}".format(*paganin.unsharp)
        sentence = f"Phase retrieval with Paganin's filter over {paganin.length:.3g} pixels ({sentence}){mask}."
        if paganin.length < 1:
            sentence += (
                " Check energy, distance and pixel size: the filter is shorter than a pixel and changes almost nothing."
            )
        return paganin, f"{sentence} {self.explanation}".rstrip()


def _stated_distance(source: ScanSource) -> float | None:
    """mm from the sample to the detector according to the file. 0 counts as unknown, because programs write 0 if nobody
    measured the distance.
    """
    stated = source.attributes.get("distance_mm")
    return stated if isinstance(stated, float) and stated > 0 else None
