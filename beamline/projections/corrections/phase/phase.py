"""Phase retrieval of a scan: its filter, by what the file and the options say of material, energy and distance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Literal

from beamline.core.errors import ConfigError
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ScanPart, ViewFilter
from beamline.projections.step import StepDone, StepMemory, option, positive

if TYPE_CHECKING:
    from beamline.projections.selection import ScanSelection
    from beamline.storage.readers.base import ScanSource
    from recon.base.geometry import Geometry
    from recon.features.phase import Paganin
    from recon.prep.projections import Projections

_AUTO = "auto"
_NO_FILTER = "No filter predicts views held out (of 16 or more) better; give --phase paganin:RATIO for delta/beta."


def _material(text: str) -> str | None:
    """What `paganin:` is followed by, or "auto"; None for "none"."""
    way, _, material = text.partition(":")
    if text not in ("none", _AUTO) and (way != "paganin" or not material):
        raise ValueError(f"{text!r} is not known; expected auto, none, paganin:RATIO (delta/beta) or paganin:MATERIAL")
    return _AUTO if text == _AUTO else material or None


def _unsharp(text: str) -> tuple[float, float]:
    """`sigma:weight`."""
    try:
        sigma, weight = (float(part) for part in text.split(":"))
    except ValueError:
        sigma = weight = math.nan
    if not (0 < sigma < math.inf and 0 <= weight < math.inf):
        raise ValueError(f"{text!r} is not SIGMA:WEIGHT with SIGMA > 0 in pixels, e.g. 1.5:2")
    return sigma, weight


@dataclass(frozen=True)
class Phase:
    """Settings of the phase retrieval.

    Attributes:
        material: the ratio of delta to beta, or a material, as the user said it; "auto": the filter follows from the
            views, where their outer edges overshoot; None: it is not retrieved.
        distance_mm: from the sample to the detector; None takes the file's.
        energy_kev: None takes the file's.
        unsharp: (sigma in pixels as they are used, weight), see `recon.features.phase.Paganin`; None: none.
        length: of the filter, in pixels as they are used, that the views show; None: none, or they were not looked at.
        explanation: of what the views show; empty: nothing certain.
    """

    name: ClassVar[str] = "phase"
    follows: ClassVar[tuple[str, ...]] = ("tilt",)
    needs_finished: ClassVar[str] = ""
    blurs: ClassVar[Literal[True]] = True  # what looks for fine detail leaves it out
    material: str | None = option(
        "--phase",
        _AUTO,
        "Phase retrieval from one distance (Paganin). X is the ratio delta/beta, or a material: a chemical formula, or "
        "a name that scenes use. auto: where outer edges of the sample overshoot, the filter that predicts views held "
        "out best.",
        parse=_material,
        metavar="auto|none|paganin:X",
    )
    distance_mm: float | None = option(
        "--distance-mm",
        None,
        "For --phase: distance from the sample to the detector. Default: from the file.",
        parse=positive,
        metavar="MM",
    )
    energy_kev: float | None = option(
        "--energy-kev", None, "For --phase: photon energy. Default: from the file.", parse=positive, metavar="KEV"
    )
    unsharp: tuple[float, float] | None = option(
        "--unsharp",
        None,
        "For --phase: unsharp mask afterwards, which restores fine detail; SIGMA in pixels.",
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
        """Delta over beta, where it was said as a number."""
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
        paganin = Paganin(1.0) if searches else self.filter_of(part.source, part.selection)[0]
        search = 4 * TRIAL_ROWS * cols * TRIAL_COPIES * (part.geometry.n_views + cols) if searches else 0
        return StepMemory((7 if self.unsharp is None else 9) * part.view_bytes(paganin.reach), search)

    def estimated(
        self, source: ScanSource, selection: ScanSelection, views: Projections, geometry: Geometry
    ) -> Phase | None:
        """This step with what these views show; None where it was said, or where nothing is certain."""
        from recon.features.phase import LEAST_DROP, length_by_held_out_views
        from recon.prep.overshoot import Overshoot

        undistorted = geometry.is_straight and not geometry.shifts.any() and source.row_pitch_mm is None
        searches = self.material == _AUTO and self.length is None and views.weights is None and undistorted
        if not searches or not (overshoot := Overshoot.of(views.data)).certain:
            return None
        floor = selection.step(Preparation).floor
        filter = length_by_held_out_views(views.data, geometry, floor, ~views.masked)
        if filter is None:
            return replace(self, explanation=f"{overshoot.in_words()} {_NO_FILTER}")
        if filter.gain < LEAST_DROP:
            why = (
                f"A filter over {filter.length:.3g} pixels lowers the residual of views held out by {filter.gain:.0%}, "
                f"and blurs cracks; it takes {LEAST_DROP:.0%} to be applied unasked. --phase paganin:RATIO applies one."
            )
            return replace(self, explanation=f"{overshoot.in_words()} {why}")
        why = (
            f"Views held out choose the square of the filter's length within {filter.factor - 1:.0%}, and their "
            f"residual is {filter.gain:.0%} lower. --phase none leaves the filter out."
        )
        return replace(self, length=filter.length, explanation=f"{overshoot.in_words()} {why}")

    def on(self, source: ScanSource, selection: ScanSelection) -> tuple[ViewFilter | None, StepDone]:
        if self.material is None or (self.material == _AUTO and self.length is None):
            why = self.explanation or (
                self.unsharp and "Without a filter --unsharp is not used; give --phase paganin:RATIO."
            )
            return None, StepDone(f"Phase: not retrieved. {why}" if why else "", {"phase": "not retrieved"})
        paganin, sentence = self.filter_of(source, selection)

        def apply(views: Projections, first: int) -> Projections:
            paganin.retrieve(views.data, selection.step(Preparation).floor)
            return views

        return ViewFilter(apply, paganin.reach, "--phase mixes"), StepDone(sentence, {"phase": sentence})

    def filter_of(self, source: ScanSource, selection: ScanSelection) -> tuple[Paganin, str]:
        """The phase filter for pixels of the selection, and a sentence about it.

        Raises:
            ConfigError: distance, energy or pixel size are not known, or give a filter that is wider than the frame.
        """
        from recon.features.phase import Paganin, length_of

        if source.row_pitch_mm is not None:
            raise ConfigError(f"--phase needs square pixels; those of {source.path} are not square.")
        cone, pitch = selection.cone, selection.pixel_size_mm
        energy = source.energy_kev if self.energy_kev is None else self.energy_kev
        distance = self.distance_mm
        if distance is None:
            distance = _stated(source) if cone is None else cone[1] - cone[0] or None
        values = {"--distance-mm": distance, "--energy-kev": energy, "--pixel-size-um": pitch}
        missing = [option for option, value in values.items() if value is None]
        if missing and self.length is None:
            raise ConfigError(f"--phase needs {' and '.join(missing)}, which {source.path} does not say.")
        length, sentence = self.length or 0.0, "by views held out"
        if not missing:
            assert distance is not None and energy is not None and pitch is not None
            near, scale = (1.0, 1.0) if cone is None else (cone[0] / (cone[0] + distance), cone[0] / cone[1])
            unit = length_of(1.0, distance * near, energy, pitch * scale * selection.binning)
            try:
                ratio = self.delta_beta(energy) if self.length is None else (self.length / unit) ** 2
            except ValueError as error:
                raise ConfigError(f"--phase paganin:{self.material}: {error}") from error
            sentence = f"delta/beta {ratio:.4g} at {energy:g} keV, {distance:g} mm behind the sample"
            length = math.sqrt(ratio) * unit
        paganin = Paganin(length, self.unsharp)
        if paganin.length > max(source.shape) / selection.binning:
            raise ConfigError(
                f"--phase: {sentence}, is a filter over {paganin.length:.4g} pixels; {source.path} has "
                f"{source.shape[0]} x {source.shape[1]}. Check ratio, energy (keV) and distance (mm)."
            )
        mask = "" if paganin.unsharp is None else "; unsharp mask of {:g} px by {:g}".format(*paganin.unsharp)
        sentence = f"Phase: Paganin's filter over {paganin.length:.3g} pixels ({sentence}){mask}."
        if paganin.length < 1:
            sentence += " It is shorter than a pixel and changes next to nothing: check energy, distance, pixel size."
        return paganin, f"{sentence} {self.explanation}".rstrip()


def _stated(source: ScanSource) -> float | None:
    """mm from the sample to the detector by the file; none of 0, which is where nobody measured it."""
    stated = source.attributes.get("distance_mm")
    return stated if isinstance(stated, float) and stated > 0 else None
