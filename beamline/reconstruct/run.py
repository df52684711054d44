"""Run: a method on prepared views, the one call by which every command makes a volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import recon
from beamline.projections.held_out import with_held_out
from beamline.projections.prepared import PreparedProjections
from recon.base.arrays import F32
from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.base.method import DataUse, Method, Reconstruction, RunControl
from recon.base.volume import Grid


def run_on(
    method: Method,
    prepared: PreparedProjections,
    grid: Grid,
    seed: int,
    control: RunControl,
    device: str = "cpu",
    reconstruct: Callable[..., Reconstruction] = recon.reconstruct,
) -> Reconstruction:
    """Run a method on these views, with those held out if it takes any, until it ends or is stopped.

    Raises:
        ValueError: the method does not take these views.
    """
    data, geometry, use = views_for(method, prepared)
    return reconstruct(data, geometry, method, grid=grid, seed=seed, device=device, use=use, control=control)


def views_for(method: Method, prepared: PreparedProjections) -> tuple[F32, Geometry, DataUse]:
    """Line integrals [view, row, col], geometry and use of the views as the method takes them."""
    data, geometry, held_out = prepared.projections.data, prepared.geometry, list[int]()
    if method.traits.held_out:
        data, geometry, held_out = with_held_out(data, geometry, prepared.held_out)
    # Rays that weigh nothing were filled on disk, as a direct method does it.
    filled = method.traits.direct and prepared.on_disk
    emission = prepared.emission  # of pixels that were binned, or beside views held out, the line integrals speak alone
    alike = emission is not None and emission.counts.shape == (geometry.n_views, *geometry.detector_shape)
    use = DataUse(
        None if filled else prepared.ray_weights(len(held_out)),
        held_out,
        emission if alike else None,
        prepared.times if method.traits.in_time else None,
        prepared.energies if method.traits.by_energy else None,
    )
    return data, geometry, use


def binned(prepared: PreparedProjections, factor: int) -> PreparedProjections:
    """The same views with factor x factor binning: means of line integrals."""
    if factor == 1:
        return prepared
    projections, counted = prepared.projections, prepared.projections.weights
    data, weights = bin_views(projections.data, factor), None
    if counted is not None:  # the mean of the rays that are known, each by what it says
        weights = bin_views(counted, factor)
        sums = bin_views(counted * projections.data, factor)
        data = np.divide(sums, weights, out=data, where=weights > 0)
    held, unseen, measured = prepared.held_out, prepared.held_out_weights, prepared.measured
    if measured is not None:
        measured = bin_views(measured[None].astype(np.float32), factor)[0] == 1
    return replace(
        prepared,
        projections=replace(projections, data=data, weights=weights),
        geometry=prepared.geometry.binned(factor),
        measured=measured,
        shares=None if prepared.shares is None else bin_views(prepared.shares, factor),
        held_out=None if held is None else (bin_views(held[0], factor), held[1].binned(factor)),
        held_out_weights=None if unseen is None else bin_views(unseen, factor),
    )
