"""Fits of all views that show more than one volume, in time or at several energies, and reconstructions by parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, Self

import numpy as np

from beamline.trials.data import TrialData
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.base.work import Costs
from recon.energy_fit import EnergyViews
from recon.series import TimedViews, fit_series, series_costs
from recon.share_fit import fit_share
from recon.spectral import fit_materials
from recon.warm_up import toy_of

VolumeAt = Callable[[float], F32]
"""The volume [z, y, x] that a view of this time, or of the energy of this number, shows."""
PartFit = Callable[[F32, Geometry, F32 | None], F32]
"""The volume of some views, by line integrals [view, row, col], geometry, and weights of rays."""
MOTION: Mapping[str, tuple[bool | None, int]] = {"none": (False, 2), "learnt": (True, 3), "chosen": (None, 5)}
"""The argument of `recon.fit_series`, and its work. Views held out choose in a trial of each."""
_TOYS = 12  # copies of the four views of a toy


class SharedFit(Protocol):
    """One fit of all views, which is no method of `recon.methods`; its fields are its settings."""

    @property
    def work(self) -> float:
        """A rough measure of the time of a view, to be compared among settings of the same fit only."""

    def fit(self, data: TrialData, seed: int, **given: Any) -> VolumeAt:
        """Fit the volumes. `given`: other arguments of the function in recon.

        Raises:
            ValueError: too few views, or settings that there are not.
        """

    def costs(self, geometry: Geometry) -> Costs | None:
        """Its work on all views; None: not known before it is tried."""

    def toy(self) -> Self:
        """The same fit with as little work as still runs its kernels."""

    def toy_data(self, geometry: Geometry) -> TrialData:
        """Small views by the same kind of beam, with times or energies as the fit needs them."""


@dataclass(frozen=True)
class SeriesFit:
    """Volumes in time, see `recon.fit_series`. `motion`: a key of `MOTION`."""

    volumes: int
    motion: str

    @property
    def work(self) -> float:
        return float(self.volumes * MOTION[self.motion][1])

    def fit(self, data: TrialData, seed: int, **given: Any) -> VolumeAt:
        lines, weights = _measured_lines(data)
        timed = TimedViews(lines, data.geometry, data.shown[: data.geometry.n_views], weights)
        return fit_series(timed, self.volumes, motion=MOTION[self.motion][0], seed=seed, **given).at

    def costs(self, geometry: Geometry) -> Costs | None:
        return series_costs(geometry, self.volumes, MOTION[self.motion][0])

    def toy(self) -> Self:
        return replace(self, volumes=2, motion="learnt" if MOTION[self.motion][0] is None else self.motion)

    def toy_data(self, geometry: Geometry) -> TrialData:
        lines, views = toy_of(geometry, _TOYS)
        return TrialData(lines, views, None, None, of_view=np.arange(views.n_views, dtype=np.float64))


@dataclass(frozen=True)
class MaterialsFit:
    """Densities of all materials, see `recon.fit_materials`. `share`: then that of two states, see `fit_share`."""

    share: bool = False

    @property
    def work(self) -> float:
        return 1.0 + self.share

    def fit(self, data: TrialData, seed: int, **given: Any) -> VolumeAt:
        sections = data.sections
        if sections is None:
            raise ValueError("views of one energy show no materials: expected scans at several energies")
        lines, weights = _measured_lines(data)
        energies = data.shown[: data.geometry.n_views].astype(np.intp)
        views = EnergyViews(lines, data.geometry, energies, sections, weights)
        made = fit_materials(views, Grid.matching(data.geometry), seed=seed, **given)
        if self.share:
            made = fit_share(views, made, (data.states[0], data.states[1]))
        return lambda energy: np.tensordot(sections[int(energy)].astype(np.float32), made.densities, 1)

    def costs(self, geometry: Geometry) -> Costs | None:
        return None

    def toy(self) -> Self:
        return self

    def toy_data(self, geometry: Geometry) -> TrialData:
        lines, views = toy_of(geometry, _TOYS)
        energies = np.arange(views.n_views, dtype=np.float64) % 2
        sections = np.array([[1, 0.5], [0.5, 1]])
        return TrialData(lines, views, None, None, of_view=energies, sections=sections, states=(0, 1))


JOINT: Mapping[str, Callable[..., SharedFit]] = {"series": SeriesFit, "materials": MaterialsFit}
"""By the name that a table gives to the method."""


def _measured_lines(data: TrialData) -> tuple[F32, F32 | None]:
    """Line integrals [view, row, col] of the views used, 0 where nothing was measured, and their weights."""
    weights = None if data.weights is None else data.weights[: data.geometry.n_views]
    return data.projections if weights is None else np.where(weights > 0, data.projections, np.float32(0)), weights


def by_parts(count: int, data: TrialData, fit: PartFit) -> VolumeAt:
    """A volume of each part of the views: of each energy, or of so long, with linear change between their middles."""
    n = data.geometry.n_views
    shown = data.shown[:n]
    if data.sections is None:
        edges = np.arange(count + 1) * n // count
        in_order = np.argsort(shown, kind="stable")
        parts = [np.sort(in_order[first:stop]) for first, stop in pairwise(edges.tolist())]
    else:
        parts = [np.flatnonzero(shown == energy) for energy in range(count)]
    weights = None if data.weights is None else data.weights[:n]
    volumes = np.stack([
        fit(data.projections[at], data.geometry.select(at), None if weights is None else weights[at]) for at in parts
    ])  # fmt: skip
    middles = np.array([shown[at].mean() for at in parts])
    return lambda view: np.tensordot(_linear(view, middles), volumes, 1)


def _linear(at: float, knots: F64) -> F32:
    return np.array([np.interp(at, knots, row) for row in np.eye(knots.size)], np.float32)
