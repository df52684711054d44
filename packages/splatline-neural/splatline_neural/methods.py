"""NAF, IntraTomo and SaxNerf: neural fields as methods, with the settings that a user can choose.

The methods differ in the network and in the rays of a step; `fit_field` fits all of them. Four things differ from the
published methods:

- Fewer steps at a higher rate, for a CPU. Published: 150 000 steps of one projection, 50 projections, rate 0.001.
- The hash grid ends when its cubes are a voxel. Published: 16 levels, most of them finer than a voxel of 256³.
- Steps use any ray that has a weight. Published: pixels above zero, so that points that only rays through air meet are
  undetermined.
- The density begins at the mean of the box. Published: at half of the highest density; with a high rate, the density
then ends at zero.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon import Geometry, Grid, Progress, Reconstruction, RunControl, Volume
from recon.base.method import ReconProblem
from recon.base.method_kinds import Iterative
from recon.base.setting import Count, NonNegative, Positive
from recon.splatting.initialise import first_volume
from recon.voxels.voxel_problem import density_unit
from splatline_neural.networks import F32, Field, HashGrid, Waves, drawn, rays_of

CHUNK = 2**15  # samples in one pass through the network
_FLOATS = 24  # floats for each sample and number of a layer: activations and their gradients
_SOME = 256  # rays of a projection from which the mean density is estimated
_DROP, _DROP_AT = 0.1, 0.5  # factor on the rate, and fraction of the run after which it is used
_TOP = 0.98  # the highest density counts as reached above this fraction of it


@dataclass(frozen=True)
class FieldMethod(Iterative):
    """Settings that all neural fields share.

    Attributes:
        steps: number of steps; each uses one projection.
        seconds: time limit from the call to the last step; `steps` also ends the run.
        allow_negative: True: the density has no limits; False: a sigmoid limits it.
        rays: number of rays in a step, drawn at random from its projection.
        samples: number of samples along a ray, 2 or more; the ray is divided into as many equal parts with a random
            point in each. None: five for every four voxels of the longest edge, as published.
        rate: learning rate of Adam; a tenth of it after half of the steps.
        highest: highest density, in density units (the 99.5th percentile of a first FBP).
        width: size of a hidden layer.
    """

    takes: ClassVar[frozenset[str]] = frozenset({"device"})
    needs_matter: ClassVar[bool] = True
    halo: ClassVar[int] = 4

    steps: Count = 3000
    seconds: NonNegative | None = None
    allow_negative: bool = False
    rays: Count = 1024
    samples: Count | None = None
    rate: Positive = 1e-2
    highest: Positive = 2.0
    width: Count = 32

    @property
    def time_limit(self) -> float | None:
        return self.seconds

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return fit_field(self, problem, control)

    @abstractmethod
    def network(self, across: int) -> Field:
        """The untrained network for a box with `across` voxels along its longest edge."""

    @property
    def limit(self) -> float | None:
        """The highest density; None: no limit."""
        return None if self.allow_negative else self.highest

    def samples_of(self, across: int) -> int:
        count = math.ceil(1.25 * across) if self.samples is None else self.samples
        return count + count % 2

    @property
    def windows(self) -> tuple[int, int]:
        """Number of windows of rays in a step, in addition to `rays`, and their edge in pixels."""
        return 0, 0

    def toy(self) -> Self:
        return replace(self, steps=2, seconds=None, rays=min(self.rays, 16))

    def for_part(self, share: float, of_time: float) -> Self:
        """The same method for a part of a volume, with a part of the time limit."""
        return replace(self, seconds=None if self.seconds is None else of_time * self.seconds)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        with torch.device("meta"):
            values = sum(part.numel() for part in self.network(max(grid.shape)).parameters())
        line = max(CHUNK, 2 * max(grid.shape))
        data = 6 * math.prod(grid.shape) + (3 + 2 * weighted) * geometry.n_views * math.prod(geometry.detector_shape)
        return 4 * (4 * values + _FLOATS * self.width * line + data)


@dataclass(frozen=True, eq=False)
class _Views:
    """Line integrals [view, row, col], in units of the box's widest edge times the density unit; weights of about
    one."""

    data: F32
    weights: F32 | None
    geometry: Geometry
    grid: Grid

    def usable(self, view: int) -> NDArray[np.bool_]:
        return np.ones(self.data.shape[1:], bool) if self.weights is None else self.weights[view] > 0

    def mean_density(self) -> float:
        """Mean density in the box, from some rays of each projection."""
        pixels = np.arange(0, self.data[0].size, max(1, self.data[0].size // _SOME))
        lengths = sum(float(rays_of(self.geometry, v, pixels, self.grid).lengths.sum()) for v in range(len(self.data)))
        return float(self.data.reshape(len(self.data), -1)[:, pixels].sum()) / max(lengths, 1e-9)


def fit_field(method: FieldMethod, problem: ReconProblem, control: RunControl) -> Reconstruction:
    """Fit the field to the projections, and sample its density at the centres of voxels.

    Raises:
        ValueError: the projections show no sample.

    Warns:
        UserWarning: rays have a width, which the field ignores; or densities reach the highest density.
    """
    begin, geometry = control.now(), problem.geometry
    if geometry.width:
        warnings.warn(
            f"the width of rays ({geometry.width}) is ignored, because a neural field supports only thin rays",
            stacklevel=2,
        )
    used = np.setdiff1d(np.arange(geometry.n_views), problem.views.held_out)
    measured = problem.views.masked()
    data, weights = measured.data, measured.weights
    grid = Grid.for_fit(geometry, problem.grid, wider=problem.wide)
    unit = density_unit(first_volume(data[used], geometry.select(used), grid).data)
    if unit <= 0 or not (data[used] > 0).any():
        raise ValueError(
            "the projections show no absorbing sample, but a neural field can be trained only on "
            "projections of a sample"
        )
    edge = float(np.ptp(grid.edges, axis=0).max())
    if weights is not None:
        weights = weights / np.float32(weights[weights > 0].mean(dtype=np.float64))
    fit = _Fit(method, _Views(data / np.float32(edge * unit), weights, geometry, grid), problem, begin, control)
    fit.run(used)
    volume = Volume(fit.volume(problem.grid) * np.float32(unit), problem.grid)
    if not method.allow_negative and volume.data.max(initial=0) > _TOP * method.highest * unit:
        warnings.warn(
            f"give a larger `highest` than {method.highest:g}: the volume reaches the highest density that the "
            f"network can represent, {method.highest * unit:.4g}",
            stacklevel=2,
        )
    record = {**asdict(method), "steps": fit.step, "planned_steps": method.steps, "seed": problem.seed}
    record |= {"device": problem.device, "density_unit": unit}
    return Reconstruction(volume, record, tuple(fit.history))


class _Fit:
    """A running fit: network, optimiser, random generator, record."""

    def __init__(
        self, method: FieldMethod, views: _Views, problem: ReconProblem, begin: float, control: RunControl
    ) -> None:
        self.method, self.views, self.control, self.begin = method, views, control, begin
        across = max(views.grid.shape)
        self.device, self.rng = torch.device(problem.device), np.random.default_rng(problem.seed)
        network = method.network(across)
        network.start(torch.Generator().manual_seed(problem.seed), views.mean_density())
        self.network = network.to(self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=method.rate, fused=True)
        self.samples, self.step = method.samples_of(across), 0
        self.history: list[Progress] = []
        self.loss = self.residual = float("nan")

    def run(self, used: NDArray[np.intp]) -> None:
        method, now = self.method, self.control.now
        usable_views = [int(view) for view in used if self.views.usable(int(view)).any()]
        order: list[int] = []
        seconds = math.inf if method.seconds is None else method.seconds
        reported = -math.inf
        while self.step < method.steps:
            share = max(self.step / method.steps, (now() - self.begin) / seconds)
            if self.step and share >= 1:
                break
            order = order or self.rng.permutation(usable_views).tolist()
            self._advance(order.pop(), method.rate * (_DROP if share >= _DROP_AT else 1.0))
            if now() - reported > 0.1:
                reported = now()
                self._report(len(used))
            if self.control.stop():
                break
        self._report(len(used))

    def _advance(self, view: int, rate: float) -> None:
        """One step of Adam on the squared differences of rays of one projection."""
        method, count = self.method, max(1, CHUNK // self.samples)
        pixels = drawn(self.rng, self.views.usable(view), method.rays, *method.windows)
        values = self.views.data[view].reshape(-1)[pixels]
        weights = np.ones_like(values) if self.views.weights is None else self.views.weights[view].reshape(-1)[pixels]
        rays = rays_of(self.views.geometry, view, pixels, self.views.grid)
        places = np.arange(self.samples, dtype=np.float32) + self.rng.random((pixels.size, self.samples), np.float32)
        points, lengths = rays.samples(places / np.float32(self.samples)), rays.lengths
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.zero_grad(set_to_none=False)
        squares = 0.0
        for first in range(0, pixels.size, count):
            part = slice(first, first + count)
            integrals = self.network(self._tensor(points[part])).mean(1) * self._tensor(lengths[part])
            loss = (self._tensor(weights[part]) * (integrals - self._tensor(values[part])) ** 2).sum() / pixels.size
            loss.backward()
            squares += float(loss.detach())
        self.optimiser.step()
        self.step += 1
        residual = math.sqrt(squares * pixels.size / max(float((weights * values**2).sum()), 1e-30))
        self.loss = squares if self.step == 1 else self.loss + 0.05 * (squares - self.loss)
        self.residual = residual if self.step == 1 else self.residual + 0.05 * (residual - self.residual)

    def _tensor(self, values: F32) -> Tensor:
        return torch.from_numpy(values).to(self.device)

    def _report(self, n_views: int) -> None:
        seconds = self.control.now() - self.begin
        self.history.append(Progress(self.step, self.method.steps, seconds, self.loss, self.residual, 0, n_views))
        self.control.tell(self.history[-1])

    @torch.no_grad()
    def volume(self, grid: Grid) -> F32:
        """Density [z, y, x] in density units at the centres of voxels. A line of the network is a line of voxels along
        x.
        """
        low, high = self.views.grid.edges
        edge = (high - low).max()
        z, y, x = (
            np.clip((coordinates - first) / edge, 0, (last - first) / edge).astype(np.float32)
            for coordinates, first, last in zip(grid.coordinates(), low[::-1], high[::-1], strict=True)
        )
        out, lines = np.empty(grid.shape, np.float32).reshape(-1, x.size), max(1, CHUNK // x.size)
        for first in range(0, len(out), lines):
            indices = np.arange(first, min(first + lines, len(out)))
            points = np.empty((indices.size, x.size, 3), np.float32)
            points[..., 0], points[..., 1], points[..., 2] = x, y[indices % y.size, None], z[indices // y.size, None]
            out[indices] = self.network(self._tensor(points)).cpu().numpy()
        return out.reshape(grid.shape)


_COARSEST = 16  # cubes along an edge in the first level


@dataclass(frozen=True)
class NAF(FieldMethod):
    """Neural attenuation field: a hash grid and a small perceptron (Zha et al. 2022, MICCAI).

    Attributes:
        levels: number of levels of the grid, 1 to 16. The first has 16 cubes along an edge, each next one twice as
            many.
            None: until a cube is a voxel.
        log2_table: base-2 logarithm of the largest number of entries in a level, 8 to 24.
    """

    name: ClassVar[str] = "naf"
    label: ClassVar[str] = "NAF"
    attention: ClassVar[bool] = False

    levels: int | None = None
    log2_table: int = 19

    def network(self, across: int) -> Field:
        to_voxels = 1 + max(0, math.ceil(math.log2(across / _COARSEST)))
        grid = HashGrid(min(to_voxels, 16) if self.levels is None else self.levels, self.log2_table)
        return Field(grid, self.width, waves=False, attention=self.attention, highest=self.limit)


@dataclass(frozen=True)
class SaxNerf(NAF):
    """SAX-NeRF: as NAF, with attention along line segments, and windows of rays (Cai et al. 2024, CVPR).

    Attributes:
        window_count, window_side: number and side of the squares of pixels in a step, in addition to `rays` outside.
    """

    name: ClassVar[str] = "sax-nerf"
    label: ClassVar[str] = "SAX-NeRF"
    attention: ClassVar[bool] = True

    window_count: int = 16
    window_side: int = 8

    @property
    def windows(self) -> tuple[int, int]:
        return self.window_count, self.window_side


@dataclass(frozen=True)
class IntraTomo(FieldMethod):
    """A field of Fourier features, the kind of network in IntraTomo's sinogram prediction (Zang et al. 2021, ICCV).

    The later refinement of IntraTomo is left out. No code of the authors is public; width and bands are our choice.

    Attributes:
        bands: number of frequencies, each twice the last; the first is one wave along an edge of the box.
    """

    name: ClassVar[str] = "intratomo"
    label: ClassVar[str] = "IntraTomo-class field"

    rate: float = 3e-3
    width: int = 128
    bands: int = 6

    def network(self, across: int) -> Field:
        return Field(Waves(self.bands), self.width, waves=True, attention=False, highest=self.limit)
