"""Gpu: the operations of a Gaussian fit on a GPU (a Backend of `recon.splatting.backend` on torch tensors)."""

from __future__ import annotations

import math

import numpy as np
import torch
import triton
import triton.language as tl
from numpy.typing import NDArray
from torch import Tensor

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.kernels.cpu.losses import ABSOLUTE, DataTerm
from recon.kernels.fused_step import StepInputs, StepModel, StepPlan
from recon.kernels.gpu import interpreted, require
from recon.kernels.gpu.footprints import BEAM, beam_of
from recon.kernels.gpu.losses import GpuProjectionLoss, neighbours, total_variation, variation
from recon.kernels.gpu.parameters import adam, adam_by, adam_rates, add_lengths
from recon.kernels.gpu.passes import GpuBox, GpuPass, GpuView
from recon.kernels.gpu.tiles import Room

_QUEUE = 128  # number of steps after which the host checks whether the lists were long enough
_RATES = 5


@triton.jit
def _tally(
    sums, variation, tv_weight, counts, rooms, means, go, pixels, ssim, VIEWS: tl.constexpr, LISTS: tl.constexpr,
    BOXED: tl.constexpr,
):  # fmt: skip
    """Check whether all lists were long enough; if so, count the step and update the running means.

    The means are those of loss and residual. `sums` [view, 4] are the sums of the loss; `counts` contains the steps and
    then the number of pairs that each list needed.
    """
    short = tl.load(counts) * 0
    for k in tl.static_range(LISTS):
        short += tl.where(tl.load(counts + 1 + k) > tl.load(rooms + k), 1, 0)
    fits = short == 0
    before, mean = tl.load(means), tl.load(means + 1)
    residual = mean
    loss = tl.load(tv_weight) * tl.load(variation) if BOXED else tl.load(variation) * 0.0
    for view in tl.static_range(VIEWS):
        loss += (tl.load(sums + 4 * view + 1) + ssim * tl.load(sums + 4 * view)) / pixels / VIEWS
        squares, power = tl.load(sums + 4 * view + 2), tl.load(sums + 4 * view + 3)
        misfit = tl.where(power > 0.0, tl.sqrt(squares / tl.where(power > 0.0, power, 1.0)), 0.0)
        residual = tl.where(residual == residual, 0.95 * residual + 0.05 * misfit, misfit)
    loss = tl.where(before == before, 0.95 * before + 0.05 * loss, loss)
    tl.store(means, tl.where(fits, loss, before))
    tl.store(means + 1, tl.where(fits, residual, mean))
    tl.store(go, tl.where(fits, 1, 0))
    tl.store(counts, tl.load(counts) + tl.where(fits, 1, 0))


class GpuStep:
    """Steps of one model with one plan, see `recon.kernels.fused_step.FusedStep`."""

    def __init__(self, model: StepModel, plan: StepPlan, device: torch.device, earlier: GpuStep | None) -> None:
        """`earlier`: steps of a model before density control; they show how long the lists become."""
        self.model, self.plan, self._device = model, plan, device
        lists, pixels = plan.views + (plan.box is not None), plan.geometry.detector_shape
        self._counts = torch.zeros(1 + lists, dtype=torch.int64, device=device)
        self._rooms = [Room(self._counts[1 + k]) for k in range(lists)]
        self._lengths = torch.zeros(lists, dtype=torch.int64, device=device)
        self._means = torch.tensor([float(model.loss), float(model.residual)], dtype=torch.float64).to(device)
        self.loss, self.residual = self._means
        self._go = torch.zeros(1, dtype=torch.int32, device=device)
        self._numbers = torch.zeros(plan.views * BEAM + _RATES + 4, device=device)
        self._images = torch.zeros((plan.views, *pixels), device=device)
        self._maps = torch.zeros((plan.views, 2, *pixels), device=device)
        self._weights = torch.ones((plan.views, *pixels), device=device) if plan.weighted else None
        self._expected = [0] * lists if earlier is None else earlier.lengths_for(model, lists)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._queued: list[StepInputs] = []
        self._beams: tuple[Geometry, dict[int, F32]] = (plan.geometry, {})

    def lengths_for(self, model: StepModel, lists: int) -> list[int]:
        """Estimated lengths of the lists for another number of Gaussians."""
        ratio = len(model.statistic) / max(1, len(self.model.statistic))
        return [math.ceil(ratio * (room.pairs or 0)) for room in self._rooms][:lists] + [0] * (lists - len(self._rooms))

    def run(self, inputs: StepInputs) -> None:
        """Queue one step."""
        self._queued.append(inputs)
        self._issue(inputs)
        if len(self._queued) >= _QUEUE:
            self.settle()

    def settle(self) -> None:
        """Wait until the arrays of the model include all steps."""
        while self._queued:
            n_done, *needed_pairs = self._counts.tolist()
            self._counts.zero_()
            self._queued = self._queued[n_done:]
            if self._queued:
                for room, pairs in zip(self._rooms, needed_pairs, strict=True):
                    if room.pairs is not None and pairs > room.pairs:
                        room.grow(pairs)
                self._prepare()
            for inputs in self._queued:
                self._issue(inputs)

    def _prepare(self) -> None:
        """Set the lengths of the lists on the device. A graph with other lengths cannot be used any more."""
        self._lengths.copy_(torch.tensor([room.pairs or 0 for room in self._rooms]))
        self._graph = None

    def _issue(self, inputs: StepInputs) -> None:
        self._load(inputs)
        if self._rooms[0].pairs is None:  # the first step counts the pairs and compiles the kernels
            self._work()
            for room, pairs in zip(self._rooms, self._expected, strict=True):
                room.pairs = max(room.pairs or 0, pairs)
            self._prepare()
        elif interpreted():
            self._work()
        else:
            if self._graph is None:
                self._graph = self._captured()
            self._graph.replay()

    def _captured(self) -> torch.cuda.CUDAGraph:
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            graph.capture_begin(capture_error_mode="thread_local")
            self._work()
            graph.capture_end()
        torch.cuda.current_stream().wait_stream(stream)
        return graph

    def _load(self, inputs: StepInputs) -> None:
        """Copy the values that differ between steps to the arrays from which the graph reads them."""
        plan = self.plan
        variation = inputs.tv_weight / max(1, neighbours(plan.box.shape)) if plan.box is not None else 0.0
        numbers = np.concatenate(
            (
                *(self._beam(inputs.geometry, view) for view in inputs.views),
                adam_rates(inputs.rates, inputs.step),
                inputs.corner[::-1],
                (variation,),
            ),
            dtype=np.float32,
        )
        self._numbers.copy_(torch.from_numpy(numbers), non_blocking=True)
        for k in range(plan.views):
            self._images[k].copy_(inputs.images[k])
            self._maps[k].copy_(inputs.target_maps[k])
            if self._weights is not None and (weights := inputs.weights[k]) is None:
                self._weights[k].fill_(1.0)
            elif self._weights is not None:
                self._weights[k].copy_(weights)

    def _beam(self, geometry: Geometry, view: int) -> F32:
        if geometry is not self._beams[0]:
            self._beams = geometry, {}
        beams = self._beams[1]
        if view not in beams:
            beams[view] = beam_of(geometry, view)
        return beams[view]

    def _work(self) -> None:
        """Launch the kernels of a step."""
        plan, model, numbers, rooms = self.plan, self.model, self._numbers, self._rooms
        means, log_scales, quaternions, raw = model.parameters
        run, views = GpuPass(means, log_scales, quaternions, raw, plan.unit, plan.kernel), plan.views
        sums, centres = [], []
        for k in range(views):
            rendered = GpuView(
                run, plan.geometry, numbers[k * BEAM : (k + 1) * BEAM], plan.faint, plan.cut, plan.rays, rooms[k]
            )
            weights = None if self._weights is None else self._weights[k]
            slope, sums_of_view = plan.loss.slope(rendered.image, self._images[k], self._maps[k], weights)
            sums.append(sums_of_view)
            centres.append(rendered.backward(slope / views if views > 1 else slope))
        rates, box_numbers = numbers[views * BEAM :].split((_RATES, 4))
        tv_weight, box_variation = box_numbers[3:], numbers.new_zeros((), dtype=torch.float64)
        if plan.box is not None:
            box = GpuBox(run, plan.box, plan.box_faint, plan.cut, box_numbers[:3], rooms[views])
            box_variation, slope = variation(box.density, tv_weight)
            box.backward(slope, means_too=plan.moves)
        loss = plan.loss
        _tally[(1,)](
            torch.cat(sums), box_variation, tv_weight, self._counts, self._lengths, self._means, self._go, loss.pixels,
            loss.ssim_weight, VIEWS=views, LISTS=len(rooms), BOXED=plan.box is not None,
        )  # fmt: skip
        for centre_gradients in centres:
            add_lengths(centre_gradients, views * plan.geometry.detector_shape[1] / 2, model.statistic, self._go)
        adam_by(model.parameters, run.gradients(), model.first, model.second, rates, plan.bounds, self._go)


class Gpu:
    """The Triton kernels on one device."""

    adam, add_lengths, total_variation = staticmethod(adam), staticmethod(add_lengths), staticmethod(total_variation)

    def __init__(self, device: str | torch.device) -> None:
        """Raises as `require`."""
        self.device = require(device)

    def array(self, values: F32) -> Tensor:
        return torch.from_numpy(np.array(values, np.float32)).to(self.device)

    def numpy(self, array: Tensor) -> F32:
        return array.detach().cpu().numpy().copy()

    def begin(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> GpuPass:  # fmt: skip
        return GpuPass(means, log_scales, quaternions, raw, unit, kernel)

    def projection_loss(
        self, shape: tuple[int, int], ssim_weight: float, term: DataTerm = ABSOLUTE
    ) -> GpuProjectionLoss:
        return GpuProjectionLoss(shape, ssim_weight, self.device, term)

    def misfit(self, image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        """||w (image - target)|| / ||w target|| (float64 scalar on the device); 0 for a target of zeros."""
        difference, weighted_target = image - target, target
        if weights is not None:
            difference, weighted_target = weights * difference, weights * weighted_target
        squares, power = (
            (difference * difference).sum(dtype=torch.float64),
            (weighted_target * weighted_target).sum(dtype=torch.float64),
        )
        return torch.where(power > 0, torch.sqrt(squares / power), 0.0)

    def unit_quaternions(self, quaternions: Tensor, first: Tensor, second: Tensor) -> None:
        length = torch.linalg.vector_norm(quaternions.double(), dim=1, keepdim=True)
        length = torch.where(length < 1e-12, 1.0, length)
        quaternions.copy_(quaternions / length)
        first.copy_(first * length)
        second.copy_(second * length**2)

    def taken(self, array: Tensor, origin: NDArray[np.int64]) -> Tensor:
        rows = torch.from_numpy(origin).to(self.device)
        rows_of_array = array[rows.clamp(min=0)]
        rows_of_array[rows < 0] = 0
        return rows_of_array

    def fused_step(self, model: StepModel, plan: StepPlan, earlier: GpuStep | None) -> GpuStep | None:
        exact = plan.geometry.is_cone and plan.rays.exact_above < math.inf
        return (
            None if exact else GpuStep(model, plan, self.device, earlier)
        )  # the number of exact rays is only known on the host
