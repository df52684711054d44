"""Phase retrieval of a scan: its filter, by what the file and the options say of material, energy and distance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from beamline.core.errors import ConfigError
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ScanPart, ViewFilter
from beamline.projections.step import StepDone, StepMemory, option, positive

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from recon.base.geometry import Geometry
    from recon.features.phase import FringesSeen, Paganin
    from recon.prep.correct import Projections
    from recon.prep.overshoot import Overshoot

_AUTO = "auto"


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
        overshoot, fringes: what the views showed; None: nothing certain, or not looked at.
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

    overshoot: Overshoot | None = field(default=None, compare=False)
    fringes: FringesSeen | None = field(default=None, compare=False)

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
        if self.material != _AUTO:
            reach, alone = self.filter_of(part.source, part.selection)[0].reach, 0
        else:
            from recon.features.phase import Paganin, search_memory

            reach, alone = Paganin(1.0, self.unsharp).reach, search_memory(part.geometry)
        return StepMemory((7 if self.unsharp is None else 9) * part.view_bytes(reach), alone)

    def learnt(self, source: ScanSource, selection: Selection, views: Projections, geometry: Geometry) -> Phase:
        """This step with the filter that these views show; itself where it was said, or where none is certain."""
        from recon.features.phase import TRIAL_ROWS, fringes_seen
        from recon.prep.overshoot import Overshoot
        from recon.voxels.field_edges import busiest_rows

        square = source.row_pitch_mm is None and geometry.rows_show_slices
        if self.material != _AUTO or views.weights is not None or not square:
            return self
        overshoot, data = Overshoot.of(views.data), views.data
        if not overshoot.certain:
            return self
        rows, height = slice(0, data.shape[1]), min(TRIAL_ROWS, data.shape[1])
        if geometry.is_cone:
            first = round(min(max(geometry.axis_row - height / 2, 0), rows.stop - height))
            rows = slice(first, first + height)
        elif height < rows.stop:
            rows = busiest_rows(data, height)
        known = ~views.masked[rows] if views.masked[rows].any() else None
        part, floor = np.ascontiguousarray(data[:, rows]), selection.step(Preparation).floor
        fringes = fringes_seen(part, geometry.rows(rows.start, rows.stop), floor, known)
        return replace(self, overshoot=overshoot, fringes=fringes)

    def on(self, source: ScanSource, selection: Selection) -> tuple[ViewFilter | None, StepDone]:
        if self.material is None or (self.material == _AUTO and self.fringes is None):
            return None, StepDone(
                "" if self.overshoot is None else _unexplained(self.overshoot), {"phase": "not retrieved"}
            )
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
        if (missing := [option for option, value in values.items() if value is None]) and self.fringes is None:
            raise ConfigError(f"--phase needs {' and '.join(missing)}, which {source.path} does not say.")
        per_ratio = math.nan  # pixels, of a ratio of 1
        if distance is not None and energy is not None and pitch is not None:
            near, scale = (1.0, 1.0) if cone is None else (cone[0] / (cone[0] + distance), cone[0] / cone[1])
            per_ratio = length_of(1.0, distance * near, energy, pitch * scale * selection.binning)
        where = f"at {energy:g} keV, {distance:g} mm behind the sample" if per_ratio > 0 else ""
        if self.fringes is not None and self.overshoot is not None:
            paganin = Paganin(self.fringes.length, self.unsharp)
            ratio = f"; delta/beta {(paganin.length / per_ratio) ** 2:.3g} {where}" if where else ""
            sentence = _seen(self.overshoot, self.fringes) + ratio
        else:
            try:
                ratio_said = self.delta_beta(energy or 0.0)
            except ValueError as error:
                raise ConfigError(f"--phase paganin:{self.material}: {error}") from error
            paganin = Paganin(math.sqrt(ratio_said) * per_ratio, self.unsharp)
            sentence = f"delta/beta {ratio_said:.4g} {where}"
        if paganin.length > max(source.shape) / selection.binning:
            raise ConfigError(
                f"--phase: {sentence}, is a filter over {paganin.length:.4g} pixels; {source.path} has "
                f"{source.shape[0]} x {source.shape[1]}. Check ratio, energy (keV) and distance (mm)."
            )
        mask = "" if paganin.unsharp is None else "; unsharp mask of {:g} px by {:g}".format(*paganin.unsharp)
        sentence = f"Phase: Paganin's filter over {paganin.length:.3g} pixels ({sentence}){mask}."
        return paganin, sentence


def _seen(overshoot: Overshoot, fringes: FringesSeen) -> str:
    """Why the filter was chosen, and how sure its length is."""
    return (
        f"fringes, or sharpened views: beside outer edges line integrals are {overshoot.share:.1%} of the edge below "
        f"the air; views held out choose the filter's square within {fringes.factor - 1:.0%} and are predicted "
        f"{fringes.gain:.0%} better; --phase none leaves it out"
    )


def _unexplained(overshoot: Overshoot) -> str:
    return (
        f"Phase: beside outer edges line integrals are {overshoot.share:.1%} of the edge below the air, as by fringes "
        "or sharpened views, but no filter predicts views held out better: none was used. Give --phase paganin:RATIO "
        "if the ratio delta/beta is known."
    )


def _stated(source: ScanSource) -> float | None:
    """mm from the sample to the detector by the file; none of 0, which is where nobody measured it."""
    stated = source.attributes.get("distance_mm")
    return stated if isinstance(stated, float) and stated > 0 else None
