"""FieldMethod, fit_field: the settings and the fit of a neural field to line integrals, whatever its network."""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from recon.base.arrays import F32, Mask
from recon.base.declared_types import Bound, Checked, Count, NonNegative, Positive
from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.method import Progress, ReconProblem, Reconstruction, RunControl, Traits
from recon.base.views import used_and_kept_back
from recon.base.volume import Grid, Volume
from recon.features.neural.networks import Field, Places, drawn, rays_of
from recon.splatting.initialise import first_volume
from recon.voxels.voxel_problem import Buffers, bytes_of, density_unit

CHUNK = 2**15  # Samples that one pass through the network takes
_FLOATS = 24  # of a sample and a number of its layers: activations and their slopes
_LOOKS, _PATIENCE = 20, 5  # looks at views held out in a run; looks without a lower residual before an early stop
_SOME = 256  # rays of a view that tell the mean density
_JUDGES = 4096  # rays of views held out
_DROP, _DROP_AT = 0.1, 0.5  # factor of the rate, and share of the run from which it holds
_FORWARD = 0.4  # share of a step's time for a sample that its way forward takes
_TOP = 0.98  # share of the highest density that counts as reached


@dataclass(frozen=True)
class FieldMethod(Checked, ABC):
    """Settings that all neural fields share.

    Attributes:
        steps: of one view each.
        seconds: of the whole run, from the call to the volume; steps end it, too.
        early_stop: return the network with the lowest residual of views held out, and end where it no longer falls.
        allow_negative: density without a limit to either side, in place of a sigmoid.
        rays: of a step, drawn at random among those of its view.
        samples: along a ray, one at random in each of as many equal parts. None: five for four voxels of the longest
            edge, as published.
        foreground: rays are drawn among pixels above zero only, as published.
        rate: of Adam; a tenth of it from half of the steps on.
        highest: density, in density units (the 99.5th percentile of a first FBP).
        width: numbers of a hidden layer.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    traits: ClassVar[Traits] = Traits(device=True, held_out=True, any_grid=True, needs_matter=True, halo=4)

    steps: Count = 3000
    seconds: NonNegative | None = None
    early_stop: bool = False
    allow_negative: bool = False
    rays: Count = 1024
    samples: Annotated[int, Bound(2)] | None = None
    foreground: bool = False
    rate: Positive = 1e-2
    highest: Positive = 2.0
    width: Count = 32

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return fit_field(self, problem, control)

    @abstractmethod
    def network(self, across: int) -> Field:
        """The network for a box of so many voxels along its longest edge, without trained values."""

    def samples_of(self, across: int) -> int:
        count = math.ceil(1.25 * across) if self.samples is None else self.samples
        return count + count % 2

    @property
    def windows(self) -> tuple[int, int]:
        """Windows of rays of a step beside `rays`, and their edge in pixels."""
        return 0, 0

    def toy(self) -> Self:
        return replace(self, steps=2, seconds=None, early_stop=False, rays=min(self.rays, 16))

    def for_part(self, share: float, of_time: float) -> Self:
        """The method for a share of a volume: with its share of the seconds."""
        return replace(self, seconds=None if self.seconds is None else of_time * self.seconds)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        across = max(grid.shape)
        with torch.device("meta"):
            values = sum(part.numel() for part in self.network(across).parameters())
        line = max(CHUNK, 2 * across)
        of_network = 4 * (4 * values + _FLOATS * self.width * line)
        return of_network + bytes_of(Buffers(6, 3, 2, filtered=True), geometry, grid, weighted)


@dataclass(frozen=True, eq=False)
class _Views:
    """Line integrals [view, row, col] in widest edges of the box times density units, and weights of about one."""

    data: F32
    weights: F32 | None
    geometry: Geometry
    grid: Grid

    def usable(self, view: int, foreground: bool) -> Mask:
        usable = np.ones(self.data.shape[1:], bool) if self.weights is None else self.weights[view] > 0
        return usable & (self.data[view] > 0) if foreground else usable

    def of(self, view: int, pixels: Places) -> tuple[F32, F32]:
        """Values and weights of some pixels of a view."""
        known = np.ones(pixels.size, np.float32) if self.weights is None else self.weights[view].reshape(-1)[pixels]
        return self.data[view].reshape(-1)[pixels], known

    def mean_density(self) -> float:
        """Mean density in the box, from some rays of each view."""
        pixels = np.arange(0, self.data[0].size, max(1, self.data[0].size // _SOME))
        lengths = sum(float(rays_of(self.geometry, v, pixels, self.grid).lengths.sum()) for v in range(len(self.data)))
        return float(self.data.reshape(len(self.data), -1)[:, pixels].sum()) / max(lengths, 1e-9)


def fit_field(method: FieldMethod, problem: ReconProblem, control: RunControl) -> Reconstruction:
    """Fit the field to the views, and sample its density at the centres of voxels.

    Raises:
        ValueError: views held out that do not exist, views without matter, an early stop without views held out, or a
            device that is not there.

    Warns:
        UserWarning: rays have a width, which a field does not know; densities reach the highest one; or the seconds
            ended before every view was seen once.
    """
    begin, geometry = control.now(), problem.geometry
    try:
        torch.zeros(1, device=problem.device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device {problem.device!r} cannot be used: {error}. Give 'cpu', or 'cuda'") from error
    if geometry.width:
        warnings.warn(f"a neural field supports only rays without a width, got {geometry.width}", stacklevel=2)
    used, kept = used_and_kept_back(geometry.n_views, tuple(problem.use.held_out), method.early_stop)
    data, weights = masked(problem.projections, problem.use.weights)
    seen = geometry.select(used)
    grid = Grid.for_fit(geometry, problem.grid, wider=problem.wide)
    unit = density_unit(first_volume(data[used], seen, grid).data)
    if unit <= 0 or not (data[used] > 0).any():
        raise ValueError("the views show no absorbing matter. A field needs views of a sample")
    edge = float(np.ptp(grid.edges, axis=0).max())
    if weights is not None:
        weights = weights / np.float32(weights[weights > 0].mean(dtype=np.float64))
    views = _Views(data / np.float32(edge * unit), weights, geometry, grid)
    fit = _Fit(method, views, problem, begin, control)
    fit.run(used, kept)
    if method.seconds is not None and fit.step < min(used.size, method.steps):
        pace = fit.seconds_of_steps / max(fit.step, 1)
        warnings.warn(
            f"{method.label} ended after {fit.step} step{'s' * (fit.step != 1)}, before it saw each of its {used.size} "
            f"views once: its volume shows little of the sample. A step takes about {pace:.2g} s here, so give about "
            f"{pace * (used.size - fit.step):.0f} s more",
            stacklevel=2,
        )
    volume = Volume(fit.volume(problem.grid) * np.float32(unit), problem.grid)
    if not method.allow_negative and volume.data.max(initial=0) > _TOP * method.highest * unit:
        warnings.warn(
            f"densities reach the highest one of the field, {method.highest * unit:.4g}: give a larger `highest` than "
            f"{method.highest:g}",
            stacklevel=2,
        )
    record = {**asdict(method), "steps": fit.step, "planned_steps": method.steps, "seed": problem.seed}
    record |= {"held_out": tuple(kept.tolist()), "device": problem.device, "density_unit": unit}
    return Reconstruction(volume, record, tuple(fit.history))


class _Best(NamedTuple):
    """The network that explains views held out best so far, and the number of the look that found it."""

    residual: float = math.inf
    look: int = 0
    network: Mapping[str, Any] | None = None


class _Fit:
    """The state of a fit: network, optimiser, random generator, record."""

    def __init__(
        self, method: FieldMethod, views: _Views, problem: ReconProblem, begin: float, control: RunControl
    ) -> None:
        self.method, self.views, self.control, self.begin = method, views, control, begin
        self.across = max(views.grid.shape)
        self.device, self.rng = torch.device(problem.device), np.random.default_rng(problem.seed)
        network = method.network(self.across)
        network.start(torch.Generator().manual_seed(problem.seed), views.mean_density())
        self.network = network.to(self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=method.rate, fused=True)
        self.samples, self.step = method.samples_of(self.across), 0
        self.history: list[Progress] = []
        self.loss = self.residual = self.held_out = float("nan")
        self.looks, self.best, self.seconds_of_steps = 0, _Best(), 0.0

    def run(self, used: Places, kept: Places) -> None:
        method, now = self.method, self.control.now
        lit = [int(view) for view in used if self.views.usable(int(view), method.foreground).any()]
        judges = self._judging_rays(kept)
        order: list[int] = []
        seconds = math.inf if method.seconds is None else method.seconds - (now() - self.begin)
        started, reported = now(), -math.inf
        room = math.prod(self.views.grid.shape) * _FORWARD / (method.rays * self.samples)  # steps as long as the volume
        while self.step < method.steps:
            spent = now() - started
            share = max(self.step / method.steps, spent / max(seconds, 1e-9))
            if self.step and spent + room * spent / self.step >= seconds:
                break
            order = order or self.rng.permutation(lit).tolist()
            self._advance(order.pop(), method.rate * (_DROP if share >= _DROP_AT else 1.0))
            if judges and share * _LOOKS >= self.looks:
                self._measure_held_out(judges)
            if now() - reported > 0.1:
                reported = now()
                self._report(len(used))
            if self.control.stop():
                break
            if method.early_stop and self.looks - self.best.look > _PATIENCE:
                break
        self.seconds_of_steps = now() - started
        if judges:
            self._measure_held_out(judges)
        self._report(len(used))
        if self.best.network:
            self.network.load_state_dict(self.best.network)

    def _advance(self, view: int, rate: float) -> None:
        """One step of Adam on the squared differences of rays of one view."""
        method, count = self.method, max(1, CHUNK // self.samples)
        pixels = drawn(self.rng, self.views.usable(view, method.foreground), method.rays, *method.windows)
        values, weights = self.views.of(view, pixels)
        rays = rays_of(self.views.geometry, view, pixels, self.views.grid)
        places = np.arange(self.samples, dtype=np.float32) + self.rng.random((pixels.size, self.samples), np.float32)
        points, lengths = rays.samples(places / np.float32(self.samples)), rays.lengths
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.zero_grad(set_to_none=False)
        squares = 0.0
        for first in range(0, pixels.size, count):
            part = slice(first, first + count)
            integrals = self._integrals(points[part], lengths[part])
            loss = (self._tensor(weights[part]) * (integrals - self._tensor(values[part])) ** 2).sum() / pixels.size
            loss.backward()
            squares += float(loss.detach())
        self.optimiser.step()
        self.step += 1
        residual = math.sqrt(squares * pixels.size / max(float((weights * values**2).sum()), 1e-30))
        self.loss = squares if self.step == 1 else self.loss + 0.05 * (squares - self.loss)
        self.residual = residual if self.step == 1 else self.residual + 0.05 * (residual - self.residual)

    def _integrals(self, points: F32, lengths: F32) -> Tensor:
        return self.network(self._tensor(points)).mean(1) * self._tensor(lengths)

    def _tensor(self, values: F32) -> Tensor:
        return torch.from_numpy(values).to(self.device)

    def _judging_rays(self, kept: Places) -> list[tuple[int, Places]]:
        """Rays of views held out, the same at every look."""
        share = -(-_JUDGES // max(1, kept.size))
        pixels_of_views = ((int(view), np.flatnonzero(self.views.usable(int(view), False))) for view in kept)
        return [(view, pixels[:: max(1, pixels.size // share)]) for view, pixels in pixels_of_views if pixels.size]

    @torch.no_grad()
    def _measure_held_out(self, judges: list[tuple[int, Places]]) -> None:
        middles = (np.arange(self.samples, dtype=np.float32) + np.float32(0.5)) / np.float32(self.samples)
        left = scale = 0.0
        for view, pixels in judges:
            for part in np.array_split(pixels, -(-pixels.size * self.samples // CHUNK)):
                values, weights = self.views.of(view, part)
                rays = rays_of(self.views.geometry, view, part, self.views.grid)
                integrals = self._integrals(rays.samples(middles), rays.lengths).cpu().numpy()
                left += float((weights * (integrals - values) ** 2).sum())
                scale += float((weights * values**2).sum())
        self.held_out = math.sqrt(left / max(scale, 1e-30))
        self.looks += 1
        if self.method.early_stop and self.held_out < self.best.residual:
            self.best = _Best(self.held_out, self.looks, copy.deepcopy(self.network.state_dict()))

    def _report(self, n_views: int) -> None:
        seconds = self.control.now() - self.begin
        self.history.append(
            Progress(self.step, self.method.steps, seconds, self.loss, self.residual, 0, n_views, self.held_out)
        )
        self.control.tell(self.history[-1])

    @torch.no_grad()
    def volume(self, grid: Grid) -> F32:
        """Density [z, y, x] in density units at the centres of voxels, whose lines along x are lines of the network."""
        low, high = self.views.grid.edges
        edge = (high - low).max()
        z, y, x = (
            np.clip((at - first) / edge, 0, (last - first) / edge).astype(np.float32)
            for at, first, last in zip(grid.coordinates(), low[::-1], high[::-1], strict=True)
        )
        out, lines = np.empty(grid.shape, np.float32).reshape(-1, x.size), max(1, CHUNK // x.size)
        for first in range(0, len(out), lines):
            at = np.arange(first, min(first + lines, len(out)))
            points = np.empty((at.size, x.size, 3), np.float32)
            points[..., 0], points[..., 1], points[..., 2] = x, y[at % y.size, None], z[at // y.size, None]
            out[at] = self.network(self._tensor(points)).cpu().numpy()
        return out.reshape(grid.shape)
