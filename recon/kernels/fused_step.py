"""StepPlan, StepModel, StepInputs: what a device needs to make a whole step of a fit without the host in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid


@dataclass(frozen=True, eq=False)
class StepPlan:
    """What stays the same from step to step.

    Attributes:
        key: two plans of one fit with equal keys are the same.
        geometry: of the views. Only its detector and beam are read.
        unit: 1/mm; densities are unit * softplus(raw).
        faint, cut: see `Pass.view`.
        views: of a step; their gradients are averaged.
        loss: of one view.
        weighted: pixels have weights.
        box: of total variation, centred at 0; None: there is none.
        box_faint: density below which Gaussians are cut off in the box.
        moves: total variation moves centres.
        bounds: of the four parameters.
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
    """Arrays on the device that steps change in place: four of parameters, their two moments, and the statistic of
    density control; `loss` and `residual` are the running means so far, NaN before the first step."""

    parameters: tuple[Any, ...]
    first: tuple[Any, ...]
    second: tuple[Any, ...]
    statistic: Any
    loss: Any
    residual: Any


@dataclass(frozen=True, eq=False)
class StepInputs:
    """What differs from step to step.

    Attributes:
        geometry: that the numbers of `views` are of.
        images, target_maps, weights: of each of the views, on the device; weights may be None.
        corner: centre (z, y, x) of the first voxel of the box, mm.
        tv_weight: of the mean |difference of neighbours| in the box, in 1 / density.
        rates: of the four parameters.
        step: from 1 on.
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
    """Steps of one model by one plan, queued on a device.

    Attributes:
        model, plan: that it was made for.
        loss, residual: running means on the device.
    """

    model: StepModel
    plan: StepPlan
    loss: Any
    residual: Any

    def run(self, inputs: StepInputs) -> None:
        """Queue one step."""

    def settle(self) -> None:
        """Wait until the arrays of the model hold all steps."""
