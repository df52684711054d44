"""Beam hardening: corrects line integrals with the curve of a stated material and beam, or with a curve fitted to
the projections.
"""

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
_COLS, _VIEWS = 160, 180  # enough projections for a curve with three parameters
_ROUNDS, _CONVERGED_CHANGE = 12, 0.01
_LEAST_INCREASE = 0.01  # relative increase of the largest line integral, from which on there is hardening
# number of projections, and of binned rows, in which hardening is searched for if the user did not ask for it
_LEAST_VIEWS, _BUSIEST_ROWS = 30, 8
# Hardening is reported without a request if two conditions are met: the correction halves the spread of the total
# absorption (a quarter of the variance; with 30 projections this is not chance, F test 1e-4), and it changes densities
# by this share.
_LARGEST_VARIATION_RATIO, _LEAST_DENSITY_CHANGE = 0.5, 0.05
# factor by which the total absorption may vary more afterwards, because the correction also amplifies noise
_VARIATION_TOLERANCE = 1e-3
_CURVE_COPIES = 16  # number of float32 copies of a projection while a curve corrects it
# number of float32 copies of the projections and of the volume during the fit of a curve
_RAY_COPIES, _VOLUME_COPIES = 10, 3
_NODE_BYTES = 40_000  # bytes of a curve per energy
_SHORTEST_PATH = 2.0  # voxels: shorter paths through the material are mostly its blurred edges


def _model(text: str) -> str | None:
    """Parse the option: `fit` or `material:beam`; None for "none"."""
    if text not in ("none", "fit") and not re.fullmatch(r"[^:]+:.+", text):
        raise ValueError(
            f"{text!r} is unknown; expected none, fit or MATERIAL:BEAM, for example Al:60kV,Al=1 (an aluminium "
            "sample, and a tube of 60 kV behind a filter of 1 mm Al) or Al:FILE"
        )
    return None if text == "none" else text


@dataclass(frozen=True)
class Hardening:
    """Settings of the beam hardening correction.

    Attributes:
        model: "fit": a curve fitted to the projections; `material:beam` as the user gave it; None: no correction.
        spectrum: the material's attenuation, in any unit, at the energies of the beam, and the share of each energy in
            the detected intensity; None: computed from `model`.
    """

    name: ClassVar[str] = "hardening"
    follows: ClassVar[tuple[str, ...]] = ("background", "calibrate", "rings")
    model: str | None = option(
        "--hardening",
        "none",
        "Correct beam hardening of a sample of one material. none: no correction. fit: with a curve "
        "fitted to the projections. MATERIAL:BEAM: with the attenuation of the material, where BEAM is a "
        "tube (60kV), a tube behind mm of filters (60kV,Al=1,Cu=0.1), or a text file with a line 'keV "
        "weight' for each energy.",
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
        return (
            ""
            if self.model is None
            else "--hardening needs a finished scan, because its curve is fitted to all projections."
        )

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=0 if self.model is None else curve_memory(part.geometry, self))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        if self.model is None:
            return StepDone(_hardening_advice(views), {"hardening": "not corrected"})
        curve, sentence = curve_of(views.seen.data, views.geometry, self)
        if curve is not None:
            curve.linearise(views.lines.data, views.lines.weights)
        return StepDone(sentence, {"hardening": sentence})


def in_beam(material: str, beam: str) -> tuple[F64, F64]:
    """Mass attenuation of a material at the energies of a beam, cm²/g, and the share of each energy in the detected
    intensity.

    Args:
        material: name of a known material, or a chemical formula.
        beam: a tube such as "60kV", behind mm of filters "60kV,Al=1,Cu=0.1". Or a text file of two columns, keV and
            weight, in any unit; the weight includes the detector's response. Filters must be known materials,
            because their density is needed.

    Raises:
        ValueError: the material or the beam is unknown or wrong; the message says which.
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
            raise ValueError(
                f"{beam} must have two columns, keV and weight, with values of 0 or more and not all weights 0"
            )
        energies, weights = table[table[:, 1] > 0].T
    return mass_attenuation(material, energies), weights


def curve_of(views: F32, geometry: Geometry, step: Hardening) -> tuple[Curve | None, str]:
    """The hardening curve for the line integrals [view, row, col] of a scan, and a sentence about it. None: no
    correction.
    """
    from recon.features.beam_hardening import NoCurveError, curve_of_spectrum

    highest = max(float(view.max()) for view in views)
    if step.spectrum is not None:
        curve, origin_of_curve = curve_of_spectrum(*step.spectrum, highest), f"of {step.model}"
    else:
        try:
            curve, explained, _ = fit_curve(views, geometry)
        except NoCurveError as error:
            return None, (
                f"Beam hardening was not corrected, because the projections do not determine the curve ({error})."
            )
        origin_of_curve = (
            f"fitted to the projections; a sample of one material explains {explained:.1%} of the variance of the line "
            "integrals"
        )
    corrected = float(np.interp(highest, curve.measured, curve.corrected))
    if corrected < (1 + _LEAST_INCREASE) * highest:
        return None, f"Beam hardening: none was found ({origin_of_curve}), so nothing was corrected."
    return curve, (
        f"Beam hardening was corrected with the curve {origin_of_curve}: line integrals of {highest:.3g} became "
        f"{corrected:.3g}."
    )


def curve_memory(geometry: Geometry, step: Hardening) -> int:
    """Peak memory in bytes for finding the hardening curve of these projections and applying it."""
    from recon.voxels.fbp import fbp_memory

    view = _CURVE_COPIES * 4 * math.prod(geometry.detector_shape)
    if step.spectrum is not None:
        return max(view, _NODE_BYTES * step.spectrum[0].size)
    _, _, reduced = _reduced(geometry)
    grid, rays = Grid.matching(reduced), reduced.n_views * math.prod(reduced.detector_shape)
    return max(
        view,
        4 * (_RAY_COPIES * rays + _VOLUME_COPIES * math.prod(grid.shape)) + fbp_memory(reduced.n_views, grid.shape[2]),
    )


def _hardening_advice(views: PreparedProjections) -> str:
    """A sentence if the rows with the most material show hardening although nobody asked for a correction; else ""."""
    from recon.voxels.beyond_field import reach_of
    from recon.voxels.field_edges import busiest_rows

    data, geometry = (ordinary := views.centred).seen.data, ordinary.geometry
    is_supported = geometry.is_straight and not geometry.is_cone and not geometry.shifts.any()
    is_supported = is_supported and views.sources.measured is None
    if not is_supported or geometry.n_views < _LEAST_VIEWS or reach_of(ordinary.seen).beyond:
        return ""
    rows = busiest_rows(data, _BUSIEST_ROWS * _reduced(geometry)[1])
    if not data[:, rows].mean() > 0 or _unevenness(data[:, rows]) < _VARIATION_TOLERANCE:
        return ""
    from recon.features.beam_hardening import NoCurveError  # imported here, because it loads scipy.optimize

    try:
        curve, _, variation_ratio = fit_curve(data[:, rows], geometry.rows(rows.start, rows.stop))
    except (NoCurveError, ValueError):
        return ""
    corrected = float(np.interp(highest := float(data[:, rows].max()), curve.measured, curve.corrected))
    if variation_ratio > _LARGEST_VARIATION_RATIO or corrected < (1 + _LEAST_DENSITY_CHANGE) * highest:
        return ""
    factor = 1 / variation_ratio
    return (
        "If the sample is of one material, give --hardening fit, because the projections show beam hardening. The "
        f"correction for one material would raise line integrals of {highest:.3g} to {corrected:.3g}. The correction "
        f"would make the total absorption of each row vary {factor:.2g} times less between projections. Nothing was "
        "corrected"
    )


def fit_curve(views: F32, geometry: Geometry) -> tuple[Curve, float, float]:
    """Fit the curve to path lengths from a first reconstruction, assuming one material.

    The path lengths are those through voxels above the middle between material and air. The volume of the next round
    is made of projections corrected with the last curve, until the curve no longer changes (after Krumm, Kasperl &
    Franz 2008, NDT & E Int. 41, 242).

    In a single projection, a sample that is denser outside than inside looks like hardening. But all projections of a
    row must have the same total absorption (the first of the Helgason-Ludwig conditions). With a wrong curve they do
    not.

    Returns:
        The curve, the share of the line integrals that path lengths explain, and the variation of the total
        absorption of corrected projections divided by that of the uncorrected ones.

    Raises:
        NoCurveError: the sample consists of several materials, the curve does not converge, or the total absorption
            varies more with it. Also if the beam is a cone, because the total absorption then need not be the same in
            all projections.
    """
    from recon.features.beam_hardening import NoCurveError, curve_of_paths
    from recon.post import k_means
    from recon.voxels.direct import direct
    from recon.voxels.projector import project

    if geometry.is_cone:
        raise NoCurveError(
            "--hardening fit needs a parallel beam, because only in a parallel beam is the total absorption the same "
            "in all projections. Give --hardening MATERIAL:BEAM instead"
        )
    view_numbers, factor, reduced = _reduced(geometry)
    measured = np.concatenate([bin_views(views[view : view + 1], factor) for view in view_numbers])
    grid, highest = Grid.matching(reduced), max(float(view.max()) for view in views)
    linearised, last_corrected = measured, math.inf
    for _ in range(_ROUNDS):
        volume = direct(linearised, reduced, grid, "hann")
        air, material = k_means(volume, 2)
        paths = project(Volume((volume > (air + material) / 2).astype(np.float32), grid), reduced)
        usable = (paths == 0) | (paths > _SHORTEST_PATH * grid.voxel_size)
        curve, explained = curve_of_paths(measured[usable], paths[usable], highest)
        corrected = float(np.interp(highest, curve.measured, curve.corrected))
        converged = abs(corrected - last_corrected) < _CONVERGED_CHANGE * corrected
        last_corrected, linearised = corrected, measured.copy()
        curve.linearise(linearised)
        if converged:
            uneven_before, uneven_after = _unevenness(measured), _unevenness(linearised)
            if uneven_after > uneven_before + _VARIATION_TOLERANCE:
                raise NoCurveError(
                    "after the correction the projections agree less with each other: their total "
                    f"absorption varies by {uneven_after:.2%} instead of {uneven_before:.2%}, for example because the "
                    "sample is denser outside"
                )
            return curve, explained, uneven_after / max(uneven_before, 1e-30)
    raise NoCurveError(f"the fit of the curve did not converge in {_ROUNDS} iterations")


def _reduced(geometry: Geometry) -> tuple[NDArray[np.int64], int, Geometry]:
    """Projections and a binning that are enough for a curve, and their geometry."""
    n, (rows, cols) = geometry.n_views, geometry.detector_shape
    view_numbers = np.unique(np.linspace(0, n - 1, min(n, _VIEWS)).astype(int))
    factor = max(1, min(round(cols / _COLS), rows))
    return view_numbers, factor, geometry.select(view_numbers).binned(factor)


def _unevenness(views: F32) -> float:
    """Relative variation of the total absorption of a row between projections; median over the rows with material."""
    absorption = views.sum(axis=2, dtype=np.float64)
    mean_absorption = absorption.mean(axis=0)
    has_material = mean_absorption > 0.1 * mean_absorption.max()
    return float(np.median(absorption.std(axis=0)[has_material] / mean_absorption[has_material]))
