"""Beam hardening: line integrals by the curve of a stated material and beam, or of what the views themselves show."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.projections.step import StepDone, StepMemory, option
from recon.base.arrays import F32, F64, bin_views
from recon.base.volume import Grid, Volume

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.protocols import ScanPart
    from recon.base.geometry import Geometry
    from recon.features.beam_hardening import Curve

    Spectrum = tuple[NDArray[np.float64], NDArray[np.float64]]

_TUBE = re.compile(r"(\d+(?:\.\d+)?)kV((?:,\w+=\d+(?:\.\d+)?)*)")
_COLS, _VIEWS = 160, 180  # enough for a curve of three parameters
_ROUNDS, _SETTLED = 12, 0.01
_LEAST_SEEN = 0.01  # growth of the largest line integral, as a share, from which on there is hardening
_FEWEST, _BUSIEST = 30, 8  # views, and binned rows, by which hardening is sought where nobody asked
_EVENED, _MATTERS = 0.5, 0.05  # a quarter of the variance, which of 30 views is no chance (F: 1e-4); share of density
_AS_EVEN = 1e-3  # that the mass may vary more: the correction amplifies noise, too
_CURVED = 16  # float32 copies of a view while a curve corrects it
_RAYS, _VOLUMES = 10, 3  # float32 copies of the views and of the volume while a curve is fitted
_NODE = 40_000  # bytes of a curve for each energy
_RIM = 2.0  # voxels: shorter paths through the material are mostly its edges


def _model(text: str) -> str | None:
    """`fit` or `material:beam`; None for "none"."""
    if text not in ("none", "fit") and not re.fullmatch(r"[^:]+:.+", text):
        raise ValueError(
            f"{text!r} is not known; expected none, fit or MATERIAL:BEAM (Al:60kV,Al=1 is a tube behind 1 mm Al; or "
            "Al:FILE)"
        )
    return None if text == "none" else text


@dataclass(frozen=True)
class Hardening:
    """Settings of the beam hardening correction.

    Attributes:
        model: "fit": by a curve that is fitted on the views; `material:beam` as the user said it; None: not at all.
        spectrum: the material's attenuation, in any unit, at the energies of the beam, and their shares of the detected
            light; None: that of `model`.
    """

    name: ClassVar[str] = "hardening"
    follows: ClassVar[tuple[str, ...]] = ("background", "calibrate", "rings")
    model: str | None = option(
        "--hardening",
        "none",
        "Correct beam hardening of a sample of one material. fit: by a curve fitted to its views. MATERIAL:BEAM: by "
        "attenuation, where BEAM is a tube (60kV), a tube behind mm of filters (60kV,Al=1,Cu=0.1), or a text file with "
        "a line 'keV weight' for each energy.",
        parse=_model,
        metavar="none|fit|MATERIAL:BEAM",
    )
    spectrum: Spectrum | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.model is None or self.model == "fit" or self.spectrum is not None:
            return
        try:
            object.__setattr__(self, "spectrum", in_beam(*self.model.split(":", 1)))
        except ValueError as error:
            raise ValueError(f"--hardening {self.model}: {error}.") from error

    @property
    def needs_finished(self) -> str:
        return "" if self.model is None else "--hardening is for a finished scan: its curve is fitted to all views."

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=0 if self.model is None else curve_memory(part.geometry, self))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        if self.model is None:
            return StepDone(_clearly_seen(views), {"hardening": "not corrected"})
        curve, sentence = curve_of(views.projections.data, views.geometry, self)
        if curve is not None:
            curve.linearise(views.projections.data, views.projections.weights)
            if views.held_out is not None:
                curve.linearise(views.held_out.data)
        return StepDone(sentence, {"hardening": sentence})


def in_beam(material: str, beam: str) -> tuple[F64, F64]:
    """Mass attenuation of a material at the energies of a beam, cm²/g, and the share of each energy in the detected
    light.

    Args:
        material: a known one, or a chemical formula.
        beam: a tube such as "60kV", behind mm of filters "60kV,Al=1,Cu=0.1". Or a text file of two columns, keV and
            weight, with the detector's response and in any unit. A filter needs its density: it is
            one of the known materials.

    Raises:
        ValueError: what is wrong with either.
    """
    from recon.prep.matter import mass_attenuation, tube_spectrum

    tube = _TUBE.fullmatch(beam)
    if tube is not None:
        filters = dict(part.split("=") for part in tube[2].split(",")[1:])
        energies, weights = tube_spectrum(float(tube[1]), {name: float(mm) for name, mm in filters.items()})
    else:
        try:
            table = np.loadtxt(beam, ndmin=2)
        except (OSError, ValueError) as error:
            raise ValueError(f"{beam} is neither a tube such as 60kV,Al=1 nor a table of keV and weight") from error
        if table.shape[1] != 2 or not (table >= 0).all() or not table[:, 1].any():
            raise ValueError(f"{beam} must hold two columns, keV and weight, 0 or more, and not all weights 0")
        energies, weights = table[table[:, 1] > 0].T
    return mass_attenuation(material, energies), weights


def curve_of(views: F32, geometry: Geometry, step: Hardening) -> tuple[Curve | None, str]:
    """The hardening curve for a scan's line integrals [view, row, col], and a sentence about it; None for no
    correction.
    """
    from recon.features.beam_hardening import NoCurveError, curve_of_spectrum

    highest = max(float(view.max()) for view in views)
    if step.spectrum is not None:
        curve, how = curve_of_spectrum(*step.spectrum, highest), f"of {step.model}"
    else:
        try:
            curve, explained, _ = fit_curve(views, geometry)
        except NoCurveError as error:
            return None, f"Hardening: not determined by the views ({error}); none corrected."
        how = f"fitted on the views; one material explains {explained:.1%} of them"
    corrected = float(np.interp(highest, curve.measured, curve.corrected))
    if corrected < (1 + _LEAST_SEEN) * highest:
        return None, f"Hardening: none seen ({how}); none corrected."
    return curve, f"Hardening: corrected by the curve {how}: line integrals of {highest:.3g} became {corrected:.3g}."


def curve_memory(geometry: Geometry, step: Hardening) -> int:
    """Peak memory in bytes of finding the hardening curve of such views and applying it."""
    from recon.voxels.fbp import fbp_memory

    view = _CURVED * 4 * math.prod(geometry.detector_shape)
    if step.spectrum is not None:
        return max(view, _NODE * step.spectrum[0].size)
    _, _, small = _small(geometry)
    grid, rays = Grid.matching(small), small.n_views * math.prod(small.detector_shape)
    return max(view, 4 * (_RAYS * rays + _VOLUMES * math.prod(grid.shape)) + fbp_memory(small.n_views, grid.shape[2]))


def _clearly_seen(views: PreparedProjections) -> str:
    """A sentence on hardening that nobody asked to correct, where the busiest rows show it; else ""."""
    from recon.voxels.field_edges import FieldEdges, busiest_rows

    data, geometry = views.centred.projections.data, views.centred.geometry
    plain = geometry.is_straight and not geometry.is_cone and not geometry.shifts.any() and views.measured is None
    if not plain or geometry.n_views < _FEWEST or FieldEdges.of(data, geometry).beyond():
        return ""
    rows = busiest_rows(data, _BUSIEST * _small(geometry)[1])
    if not data[:, rows].mean() > 0 or _unevenness(data[:, rows]) < _AS_EVEN:
        return ""
    from recon.features.beam_hardening import NoCurveError  # here, because it loads scipy.optimize

    try:
        curve, _, evened = fit_curve(data[:, rows], geometry.rows(rows.start, rows.stop))
    except (NoCurveError, ValueError):
        return ""
    corrected = float(np.interp(highest := float(data[:, rows].max()), curve.measured, curve.corrected))
    if evened > _EVENED or corrected < (1 + _MATTERS) * highest:
        return ""
    return (
        f"Hardening: line integrals of {highest:.3g} would be {corrected:.3g} by the curve of one material, and the "
        f"mass of a row would vary {1 / evened:.2g} times less from view to view; nothing was corrected. Give "
        "--hardening fit if the sample is of one material"
    )


def fit_curve(views: F32, geometry: Geometry) -> tuple[Curve, float, float]:
    """Fit the curve to path lengths from a first reconstruction, assuming one material.

    The paths are those through voxels brighter than the middle between matter and air. The next round's volume is of
    views corrected by the last curve, until it stays (after Krumm, Kasperl & Franz 2008, NDT & E Int. 41, 242).

    A sample that is denser outside than inside looks the same in any one view. But all views of a row hold the same
    mass (the first of the Helgason-Ludwig conditions), and a wrong curve spoils that.

    Returns:
        The curve, the share of the line integrals that path lengths explain, and the variation of the masses of
        corrected views over that of the views.

    Raises:
        NoCurveError: the sample is of several materials, the curve does not settle, or it makes masses differ more. Or
            the beam is a cone, whose views need not hold the same mass.
    """
    from recon.features.beam_hardening import NoCurveError, curve_of_paths
    from recon.post import k_means
    from recon.reconstruction import reconstruct
    from recon.voxels.projector import project

    if geometry.is_cone:
        raise NoCurveError(
            "a fit needs a parallel beam, in which all views show the same mass: state material and beam"
        )
    some, factor, small = _small(geometry)
    measured = np.concatenate([bin_views(views[view : view + 1], factor) for view in some])
    grid, highest, now, before = Grid.matching(small), max(float(view.max()) for view in views), measured, math.inf
    for _ in range(_ROUNDS):
        volume = reconstruct(now, small, "fbp", grid=grid).volume.data
        air, matter = k_means(volume, 2)
        paths = project(Volume((volume > (air + matter) / 2).astype(np.float32), grid), small)
        clear = (paths == 0) | (paths > _RIM * grid.voxel_size)
        curve, explained = curve_of_paths(measured[clear], paths[clear], highest)
        corrected = float(np.interp(highest, curve.measured, curve.corrected))
        settled = abs(corrected - before) < _SETTLED * corrected
        before, now = corrected, measured.copy()
        curve.linearise(now)
        if settled:
            uneven, after = _unevenness(measured), _unevenness(now)
            if after > uneven + _AS_EVEN:
                raise NoCurveError(
                    f"corrected views agree less with each other: their mass varies by {after:.2%} instead of "
                    f"{uneven:.2%}, as where a sample is denser outside"
                )
            return curve, explained, after / max(uneven, 1e-30)
    raise NoCurveError(f"the curve does not converge in {_ROUNDS} iterations")


def _small(geometry: Geometry) -> tuple[NDArray[np.int64], int, Geometry]:
    """Views and a binning that are enough for a curve, and the geometry that they have."""
    n, (rows, cols) = geometry.n_views, geometry.detector_shape
    some = np.unique(np.linspace(0, n - 1, min(n, _VIEWS)).astype(int))
    factor = max(1, min(round(cols / _COLS), rows))
    return some, factor, geometry.select(some).binned(factor)


def _unevenness(views: F32) -> float:
    """How much the mass of a row varies from view to view, as a share: the median over the rows that hold some."""
    mass = views.sum(axis=2, dtype=np.float64)
    mean = mass.mean(axis=0)
    filled = mean > 0.1 * mean.max()
    return float(np.median(mass.std(axis=0)[filled] / mean[filled]))
