"""reconstruct: one call from line integrals to a volume, by any registered method."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.auto import method_named
from recon.base.arrays import some_values, without_mask
from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry, require_views, unseen_axis
from recon.base.method import (
    DataUse,
    Method,
    ReconProblem,
    Reconstruction,
    RunControl,
)
from recon.base.method_kinds import Direct
from recon.base.setting import Natural
from recon.base.units import warn_of_degrees, warn_of_other_quantity
from recon.base.view_data import Views
from recon.base.views import used_views
from recon.base.volume import Grid
from recon.methods import DEFAULT, accepting
from recon.prep.counts import Counts, line_integrals
from recon.voxels.beyond_field import reach_of, run_on_extended_grid
from recon.voxels.view_weights import covers_the_circle, density_errors, unseen_wedges

if TYPE_CHECKING:
    from torch import Tensor

# number of values in the sample; largest line integral (measured ones end at about 15)
_SAMPLED_VALUES, _LARGEST_LINE_INTEGRAL = 2**16, 1e15


def reconstruct(
    projections: ArrayLike | Tensor | Counts | Views,
    geometry: Geometry | None = None,
    method: str | Method = DEFAULT,
    *,
    grid: Grid | None = None,
    seed: Natural = 0,
    device: str = "cpu",
    use: DataUse | None = None,
    control: RunControl | None = None,
) -> Reconstruction:
    """Reconstruct a volume from line integrals.

    Values that are masked or not finite are filled from their neighbours and get weight 0. If photons are few, give the
    measured `Counts` instead of line integrals. `Counts` are converted to line integrals with weights that
    represent the likelihood of the counts (`recon.prep.counts.line_integrals`). The weights from the counts are
    multiplied by `use.weights`. `Views` contain their geometry, their weights and how far the sample reaches,
    so `reconstruct` measures none of these again.

    A fit always covers everything that the projections see. Therefore the voxels of a smaller box that you ask for are
    identical to the same voxels of the whole volume.

    Args:
        projections: [view, row, col], -log of the transmission; any real type (a CPU tensor too); or `Counts` or
            `Views`.
        geometry: geometry of the projections; None for `Views`.
        method: a name ("auto", or see `recon.methods.names`) for a method with its default settings, or a method with
            settings of its own, such as `recon.R2(steps=2000)` or `recon.FistaTv(tv_weight=2e-3)`.
        grid: grid of the volume; None: one voxel per detector pixel.
        seed: seed of every random choice; the same seed gives the same volume on the same machine with the same number
            of threads.
        device: where the method computes: "cpu" or "cuda" (the current CUDA device).
        use: weights of the rays, and held-out projections; None: equal weights, and all projections are used.
        control: how to follow, stop and resume the reconstruction.

    Raises:
        ValueError: the method is unknown, `Views` are given together with something that `Views` contain (a geometry,
            weights, held-out projections or a sample radius), shapes do not match, all projections are from one side,
            the axis is outside the detector, the projections show no material, the seed is negative, or the method
            cannot use the projections, the held-out projections, the device or the checkpoint.

    Warns:
        UserWarning: values whose weight is not 0 are not finite; the angles look like degrees; the projections look
            like counts, transmission, or line integrals of the wrong sign; densities are uncertain, because a part of
            the turn has no projections.
    """
    projections = without_mask(projections)
    check_arguments(reconstruct, locals())
    chosen = method_named(method) if isinstance(method, str) else method
    use, control = use or DataUse(), control or RunControl()
    _refuse_foreign(chosen, device, use, control)
    views = _views(projections, geometry, use)
    data, geometry = views.data, views.geometry
    if not isinstance(projections, Counts):
        warn_of_other_quantity(data)
        _warn_of_unknown(data, views.weights)
    if not chosen.allow_negative:  # a method with that setting can make such voxels
        _warn_of_negative(data)
    warn_of_degrees(geometry.angles)
    _warn_of_unseen_cone(chosen, geometry)
    _warn_of_missing_wedge(chosen, geometry)
    views = replace(views if "held_out" in chosen.takes else views.seen, reach=reach_of(views))
    _warn_of_half_acquisition(views)
    begin = control.now()
    problem = ReconProblem(views, grid or Grid.matching(geometry), use, int(seed), device)
    result = run_on_extended_grid(chosen, problem, control)
    method_name, seconds = result.method or chosen.name, result.seconds or control.now() - begin
    return replace(result, settings=dict(result.settings), method=method_name, seconds=seconds)


def _warn_of_unknown(data: NDArray[np.float32], weights: Any) -> None:
    """Warn if values are not finite, except those with weight 0."""
    lost = sum(
        int((~np.isfinite(view) & (True if weights is None else np.asarray(weights[number] > 0))).sum())
        for number, view in enumerate(data)
        if not np.isfinite(view).all()
    )
    if 0 < lost < data.size:
        warnings.warn(
            f"{lost} of {data.size} values of the projections are not finite. These values are filled from their "
            f"neighbours and get weight 0. To avoid this warning, give these values the weight 0 in DataUse(weights)",
            stacklevel=3,
        )


def _warn_of_negative(data: NDArray[np.float32]) -> None:
    sampled = data[:: max(1, len(data) // 16)]
    sampled = sampled[np.isfinite(sampled)]
    if sampled.sum(dtype=np.float64) < -np.abs(sampled).sum(dtype=np.float64) / 2:
        warnings.warn(
            "change the sign of the projections: most of their values are below 0 (mean "
            f"{sampled.mean(dtype=np.float64):.4g}), but line integrals of material, -log of the transmission, are "
            "above 0. If the projections are differences, set allow_negative in methods that clip voxels at 0",
            stacklevel=3,
        )


def _warn_of_unseen_cone(method: Method, geometry: Geometry) -> None:
    lean = geometry.unseen_cone
    if lean and any(each.trial_sweeps for each in method.alternatives):
        warnings.warn(
            "set the weight of total variation yourself: use fista-tv with tv_weight 0.001, or with 0.002 for a plate "
            "with sharp edges. The automatic weight is too small for this scan. The rotation axis is tilted along the "
            f"beam by {math.degrees(lean):.3g} degrees or more in all projections, so no projection shows the faces of "
            "a plate that lies across the axis. The held-out projections, which choose the weight, do not show these "
            "faces either",
            stacklevel=3,
        )


def _warn_of_missing_wedge(method: Method, geometry: Geometry) -> None:
    """Warn that the densities of a direct method are wrong. Those of iterative methods are right, because these methods
    explain the line integrals."""
    if geometry.is_cone or not isinstance(method, Direct) or not (unseen := unseen_wedges(geometry)):
        return
    missing = sum(wedge.size for wedge in unseen)
    low, high = density_errors(min(missing, math.pi * (1 - 1e-3)))
    warnings.warn(
        f"for correct densities use an iterative method such as fista-tv, because {math.degrees(missing):.3g} of "
        f"180 degrees have no projection. {method.label} multiplies densities by "
        f"{math.pi / (math.pi - missing):.4g}, which is right only for round bodies. The density of a body twice as "
        f"long as wide is wrong by {100 * low:+.0f} to {100 * high:+.0f} %",
        stacklevel=3,
    )


def _warn_of_half_acquisition(views: Views) -> None:
    """Warn if a sample reaches beyond the edge near the axis, and no full circle shows what is beyond that edge."""
    geometry = views.geometry
    if not geometry.is_off_middle or covers_the_circle(geometry.angles):
        return
    columns_left, columns_right = geometry.axis_col + 0.5, geometry.detector_shape[1] - 0.5 - geometry.axis_col
    if ("left" if columns_left < columns_right else "right") in reach_of(views).beyond:
        warnings.warn(
            "take projections over 360 degrees without a gap, or do not rely on the densities: the sample reaches "
            f"beyond the edge of the detector that is {min(columns_left, columns_right):.0f} columns from the rotation "
            "axis, and only a full circle shows all rays that are farther from the axis than this edge. Without a full "
            "circle, densities in our tests were too low: by up to a third with FBP, by up to an eighth with iterative "
            "methods (docs/numerics.md)",
            stacklevel=3,
        )


def _refuse_geometry(geometry: Geometry) -> None:
    """Raise ValueError if all projections are from one side, or if the axis is outside the detector."""
    # Parallel projections 180° apart contain the same rays, so |sin| of the angle between two shows whether they
    # differ. Projections of a cone, and those with a tilt along the beam, differ up to 360°.
    scaled_angle = (geometry.angles - geometry.angles[0]) / (2 if geometry.is_cone or geometry.tilt.any() else 1)
    if np.abs(np.sin(scaled_angle)).max() < 1e-6:
        raise ValueError(
            "give projections at two or more different angles, because one direction does not determine a volume; "
            f"got only one direction, {np.rad2deg(geometry.angles[0]):g} degrees (number of projections: "
            f"{geometry.n_views})"
        )
    if sentence := unseen_axis(geometry.axis_col + geometry.offsets[:, 0], geometry.detector_shape[1]):
        raise ValueError(sentence)


def _refuse_foreign(method: Method, device: str, use: DataUse, control: RunControl) -> None:
    """Raise ValueError for arguments that the method would silently ignore."""
    wanted = {
        f"device {device!r}": ("device", device != "cpu"),
        "held_out": ("held_out", len(use.held_out) > 0),
        "times": ("times", use.times is not None),
        "resume": ("checkpoints", control.resume is not None),
        "on_checkpoint": ("checkpoints", control.on_checkpoint is not None),
    }
    foreign = [
        (argument, capability)
        for argument, (capability, is_given) in wanted.items()
        if is_given and capability not in method.takes
    ]
    if foreign:
        owners = ", ".join(f"{argument} (of {', '.join(accepting(capability))})" for argument, capability in foreign)
        raise ValueError(
            f"method {method.name!r} has no option {owners}: leave the option out, or choose another method"
        )


def _views(projections: ArrayLike | Tensor | Counts | Views, geometry: Geometry | None, use: DataUse) -> Views:
    """Line integrals with their weights and their geometry, as far as it can be used."""
    if isinstance(projections, Views):
        arguments = {
            "geometry": geometry is not None,
            "use.weights": use.weights is not None,
            "use.held_out": len(use.held_out) > 0,
            "use.sample_radius": use.sample_radius is not None,
        }
        if twice := [name for name, is_given in arguments.items() if is_given]:
            raise ValueError(
                f"leave out {' and '.join(twice)}, because the projections are given as Views, which contain this "
                "information"
            )
        _refuse_geometry(projections.geometry)
        weights = None if projections.weights is None else projections.weights[...]
        return replace(projections, data=_line_integrals(projections.data, projections.geometry), weights=weights)
    if geometry is None:
        raise ValueError(
            "give the geometry of the projections (the argument `geometry`). It can be left out only if the "
            "projections are `Views`, which contain it"
        )
    _refuse_geometry(geometry)
    used = used_views(geometry.n_views, use.held_out) if len(use.held_out) else None
    if not isinstance(projections, Counts):
        return Views(_line_integrals(projections, geometry), geometry, use.weights, used=used)
    require_views(geometry, projections.counts, "counts")
    if use.weights is not None:
        require_views(geometry, use.weights, "weights")
    data, weights = line_integrals(projections)
    weights = weights if use.weights is None else weights * use.weights
    return Views(_line_integrals(data, geometry), geometry, weights, used=used)


def _line_integrals(projections: ArrayLike, geometry: Geometry) -> NDArray[np.float32]:
    array = np.asarray(projections.detach() if hasattr(projections, "detach") else projections)  # a tensor
    if array.dtype.kind not in "fiub":
        raise ValueError(f"projections must be real numbers, got {array.dtype}")
    require_views(geometry, array)
    with np.errstate(over="ignore"):  # values outside the range of float32 count as not finite
        data = np.ascontiguousarray(array, np.float32)
    sampled = np.abs(some_values(data, _SAMPLED_VALUES))
    sampled = sampled[np.isfinite(sampled)]
    if sampled.size and (largest := float(np.quantile(sampled, 0.9))) > _LARGEST_LINE_INTEGRAL:
        raise ValueError(
            f"the line integrals are too large: one in ten is above {largest:.3g}, and sums of squares of values above "
            f"{_LARGEST_LINE_INTEGRAL:g} exceed the range of float32. Divide the line integrals by a constant; the "
            "volume is then divided by the same constant"
        )
    return data
