"""StepPlan, StepModel, StepInputs: the data with which a device makes a complete fitting step without the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid


@dataclass(frozen=True, eq=False)
class StepPlan:
    """Values that are the same in all steps.

    Attributes:
        key: two plans of one fit with equal keys are equal.
        geometry: geometry of the projections; only its detector and beam are used.
        unit: 1/mm; densities are unit * softplus(raw).
        faint, cut: see `Pass.view`.
        views: number of projections in a step; their gradients are averaged.
        loss: loss of one projection.
        weighted: True if pixels have weights.
        box: box of total variation, centred at 0; None: no total variation.
        box_faint: Gaussians are cut off below this density in the box.
        moves: True if total variation moves centres.
        bounds: bounds of the four parameters.
    """

    key: tuple[Any, ...]
    geometry: Geometry
    kernel: Kernel
    rays: RayModel
    unit: float
    faint: float
    cut: float
    views: int
    loss: Any
    weighted: bool
    box: Grid | None
    box_faint: float
    moves: bool
    bounds: tuple[tuple[float, float] | None, ...]


@dataclass(frozen=True, eq=False)
class StepModel:
    """Arrays on the device that steps change in place.

    They are the four parameter arrays, their two moments, and the statistic of density control. `loss` and `residual`
    are the running means so far, NaN before the first step.
    """

    parameters: tuple[Any, ...]
    first: tuple[Any, ...]
    second: tuple[Any, ...]
    statistic: Any
    loss: Any
    residual: Any


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Values that differ between steps.

    Attributes:
        geometry: geometry to which the numbers in `views` refer.
        images, target_maps, weights: for each of these projections, on the device; weights may be None.
        corner: centre (z, y, x) of the first voxel of the box, mm.
        tv_weight: weight of the mean |difference of neighbours| in the box, in 1 / density.
        rates: learning rates of the four parameters.
        step: number of the step, from 1.
    """

    geometry: Geometry
    views: Sequence[int]
    images: Sequence[Any]
    target_maps: Sequence[Any]
    weights: Sequence[Any]
    corner: tuple[float, float, float]
    tv_weight: float
    rates: Sequence[float]
    step: int


class FusedStep(Protocol):
    """Steps of one model with one plan, queued on a device.

    Attributes:
        model, plan: the model and plan it was made for.
        loss, residual: running means on the device.
    """

    model: StepModel
    plan: StepPlan
    loss: Any
    residual: Any

    def run(self, inputs: StepInputs) -> None:
        """Queue one step."""

    def settle(self) -> None:
        """Wait until the arrays of the model include all steps."""
