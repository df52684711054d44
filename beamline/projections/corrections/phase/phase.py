"""Phase retrieval of a scan: its filter, by what the file and the options say of material, energy and distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from beamline.core.errors import ConfigError
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ScanPart, ViewFilter
from beamline.projections.step import StepDone, StepMemory, option, positive

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from recon.features.phase import Paganin
    from recon.prep.correct import Projections


def _material(text: str) -> str | None:
    """What `paganin:` is followed by; None for "none"."""
    way, _, material = text.partition(":")
    if text != "none" and (way != "paganin" or not material):
        raise ValueError(f"{text!r} is not known; expected none, paganin:RATIO (delta/beta) or paganin:MATERIAL")
    return material or None


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
        material: the ratio of delta to beta, or a material, as the user said it; None: it is not retrieved.
        distance_mm: from the sample to the detector; None takes the file's.
        energy_kev: None takes the file's.
        unsharp: (sigma in pixels as they are used, weight), see `recon.features.phase.Paganin`; None: none.
    """

    name: ClassVar[str] = "phase"
    follows: ClassVar[tuple[str, ...]] = ("tilt",)
    needs_finished: ClassVar[str] = ""
    blurs: ClassVar[Literal[True]] = True  # what looks for fine detail leaves it out
    material: str | None = option(
        "--phase",
        "none",
        "Phase retrieval from one distance (Paganin). X is the ratio delta/beta, or a material: a chemical formula, or "
        "a name that scenes use.",
        parse=_material,
        metavar="none|paganin:X",
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
        if self.material is None:
            return StepMemory()
        paganin, _ = self.filter_of(part.source, part.selection)
        return StepMemory((7 if self.unsharp is None else 9) * part.view_bytes(paganin.reach))

    def on(self, source: ScanSource, selection: Selection) -> tuple[ViewFilter | None, StepDone]:
        if self.material is None:
            return None, StepDone("", {"phase": "not retrieved"})
        paganin, sentence = self.filter_of(source, selection)

        def apply(views: Projections, first: int) -> Projections:
            paganin.retrieve(views.data, selection.step(Preparation).floor)
            return views

        return ViewFilter(apply, paganin.reach, "--phase mixes"), StepDone(sentence, {"phase": sentence})

    def filter_of(self, source: ScanSource, selection: Selection) -> tuple[Paganin, str]:
        """The phase filter for pixels of the selection, and a sentence about it.

        Raises:
            ConfigError: distance, energy or pixel size are not known, or give a filter that is wider than the frame.
        """
        from beamline.projections.selection import cone_of, pixel_size
        from recon.features.phase import Paganin, length_of

        if source.row_pitch_mm is not None:
            raise ConfigError(f"--phase needs square pixels; those of {source.path} are not square.")
        cone, pitch = cone_of(source, selection), pixel_size(source, selection)
        energy = source.energy_kev if self.energy_kev is None else self.energy_kev
        distance = self.distance_mm
        if distance is None:
            distance = _stated(source) if cone is None else cone[1] - cone[0]
        values = {"--distance-mm": distance, "--energy-kev": energy, "--pixel-size-um": pitch}
        if missing := [option for option, value in values.items() if value is None]:
            raise ConfigError(f"--phase needs {' and '.join(missing)}, which {source.path} does not say.")
        assert distance is not None and energy is not None and pitch is not None
        try:
            ratio = self.delta_beta(energy)
        except ValueError as error:
            raise ConfigError(f"--phase paganin:{self.material}: {error}") from error
        sentence = f"delta/beta {ratio:.4g} at {energy:g} keV, {distance:g} mm behind the sample"
        if cone is not None:
            distance, pitch = distance * cone[0] / (cone[0] + distance), pitch * cone[0] / cone[1]
        paganin = Paganin(length_of(ratio, distance, energy, pitch * selection.binning), self.unsharp)
        if paganin.length > max(source.shape) / selection.binning:
            raise ConfigError(
                f"--phase: {sentence}, is a filter over {paganin.length:.4g} pixels; {source.path} has "
                f"{source.shape[0]} x {source.shape[1]}. Check ratio, energy (keV) and distance (mm)."
            )
        mask = "" if paganin.unsharp is None else "; unsharp mask of {:g} px by {:g}".format(*paganin.unsharp)
        sentence = f"Phase: Paganin's filter over {paganin.length:.3g} pixels ({sentence}){mask}."
        return paganin, sentence


def _stated(source: ScanSource) -> float | None:
    """mm from the sample to the detector by the file; none of 0, which is where nobody measured it."""
    stated = source.attributes.get("distance_mm")
    return stated if isinstance(stated, float) and stated > 0 else None
