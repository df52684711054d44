"""Motion: the motion of a sample during the scan, smooth in space and time, estimated from the projections.

    x(r, t) = Σ_k h_k(t) d_k(r + u(r, t)),    u(r, t) = Σ_m s_m(t) Σ_c B_c(r) a_mc

h_k are hat functions in time; s_m and B_c are natural cubic splines through a few knots. u is 0 in the middle of the
scan, so d describes the sample at that time. The control points a come from Gauss-Newton steps. In each step, the
projected gradients of the volume along u are fitted to the residual of the projections. (Zang et al. 2018, ACM Trans.
Graph. 37, 138, use optical flow between volumes.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from recon.base.arrays import F32, F64
from recon.kernels.cpu.warp import pull, push, slopes
from recon.voxels.projector import Projector

A = TypeVar("A", F32, F64)

MIDDLE = 0.5  # time within the scan at which u is 0
_STEPS = 8  # number of conjugate-gradient iterations
# weight that penalises differences between neighbouring control points, divided by the typical curvature of a control
# point
_DIFFERENCE_WEIGHT = 0.03
_VALUE_WEIGHT = 1e-3  # the same for the values of the control points


@dataclass(frozen=True, eq=False)
class Motion:
    """Displacements of a volume [y, x, z] at some times.

    Attributes:
        shape: shape of the volume.
        times: [time] within the scan, 0 to 1.
        control: a, float64 [knot in time, 3, control y, x, z], in voxels along y, x, z.
    """

    shape: tuple[int, int, int]
    times: F64
    control: F64

    @classmethod
    def none(cls, shape: tuple[int, int, int], times: F64, knots: int, controls: int) -> Motion:
        """Zero motion, with `knots` knots in time and `controls` control points along each axis."""
        return cls(shape, times, np.zeros((knots, 3, *(min(controls, n) for n in shape))))

    def on(self, shape: tuple[int, int, int], times: F64) -> Motion:
        """The same motion on voxels of another size, at other times."""
        return Motion(shape, times, self.control * (shape[1] / self.shape[1]))

    @cached_property
    def _space(self) -> list[F64]:
        return [_spline(np.linspace(0, 1, n), c) for n, c in zip(self.shape, self.control.shape[2:], strict=True)]

    @cached_property
    def _shares(self) -> F64:
        """s_m [time, knot]."""
        knots = len(self.control)
        return _spline(self.times, knots) - _spline(np.array([MIDDLE]), knots)

    def at(self, time: int, control: F64 | None = None) -> F32:
        """The displacement u [3, y, x, z] at a time. `control` replaces the control points, if given."""
        y, x, z = (part.astype(np.float32) for part in self._space)
        part = np.tensordot(self._shares[time], self.control if control is None else control, 1).astype(np.float32)
        displacement = np.einsum("yp,dpqr->dyqr", y, part)
        displacement = np.einsum("xq,dyqr->dyxr", x, displacement)
        return np.ascontiguousarray(displacement @ z.T)

    def back(self, time: int, field: F32) -> F64:
        """The transpose of `at`: from a field [3, y, x, z] to control points."""
        y, x, z = self._space
        gradient = np.einsum("xq,dyxr->dyqr", x, (field @ z.astype(np.float32)).astype(np.float64))
        gradient = np.einsum("yp,dyqr->dpqr", y, gradient)
        return np.asarray(np.multiply.outer(self._shares[time], gradient))


def _spline(times: F64, knots: int) -> F64:
    """Natural cubic splines through `knots` evenly spaced knots in 0 to 1, [place, knot].

    With two knots the splines are straight lines; with one knot, the spline is the constant 1.
    """
    if knots == 1:
        return np.ones((times.size, 1))
    positions = np.linspace(0, 1, knots)
    if knots == 2:
        return np.stack([1 - times, times], 1)
    from scipy.interpolate import CubicSpline  # loading takes half a second

    return np.asarray(CubicSpline(positions, np.eye(knots), bc_type="natural")(times))


@dataclass(frozen=True, eq=False)
class Seen:
    """Projections at one time, as [view, col, row]. If `weight` is None, all weights are 1."""

    time: int
    projector: Projector
    data: F32
    weight: F32 | None


def descent(motion: Motion, energies: Sequence[Seen], image: Callable[[int], F32]) -> tuple[F64, list[F32]]:
    """The negative gradient of half the weighted squares with respect to the control points, and the derivatives of W x
    with respect to u."""
    negative_gradient, volume_slopes = np.zeros_like(motion.control), list[F32]()
    for part in energies:
        u, x = motion.at(part.time), image(part.time)
        residual = part.data - part.projector.forward_lines(moved(x, u))
        volume_slopes.append(np.empty_like(u))
        slopes(x, u, volume_slopes[-1])
        negative_gradient += motion.back(
            part.time, volume_slopes[-1] * part.projector.adjoint_lines(weighed(residual, part.weight))
        )
    return negative_gradient, volume_slopes


def improved(motion: Motion, energies: Sequence[Seen], image: Callable[[int], F32]) -> Motion:
    """The motion after a Gauss-Newton step on the projections, with differences between control points kept small.

    Args:
        image: function that returns the volume [y, x, z] at a time, before it is displaced.
    """
    negative_gradient, volume_slopes = descent(motion, energies, image)

    def curved(control: F64) -> F64:
        out = np.zeros_like(control)
        for part, volume_slope in zip(energies, volume_slopes, strict=True):
            change = np.einsum("dyxz,dyxz->yxz", volume_slope, motion.at(part.time, control))
            lines = weighed(part.projector.forward_lines(change), part.weight)
            out += motion.back(part.time, volume_slope * part.projector.adjoint_lines(lines))
        return out

    start = np.random.default_rng(0).standard_normal(motion.control.shape)
    typical = float(np.vdot(start, curved(start)) / np.vdot(start, start))

    def normal(control: F64) -> F64:
        return curved(control) + typical * _roughness_gradient(control)

    step = np.zeros_like(negative_gradient)  # with few iterations, large motions are found first
    conjugate_gradients(normal, negative_gradient - typical * _roughness_gradient(motion.control), step, _STEPS)
    return Motion(motion.shape, motion.times, motion.control + step)


def weighed(lines: F32, weight: F32 | None) -> F32:
    """The lines multiplied by the weights of their rays, if there are any."""
    return lines if weight is None else weight * lines


def _roughness_gradient(control: F64) -> F64:
    """Gradient of half the weighted squares of two quantities: differences between neighbours in space, and the values
    themselves."""
    out = _VALUE_WEIGHT * control
    for axis in (2, 3, 4):
        padding = [(0, 0)] * 5
        padding[axis] = (1, 1)
        out -= _DIFFERENCE_WEIGHT * np.diff(np.pad(np.diff(control, axis=axis), padding), axis=axis)
    return out


def conjugate_gradients(
    normal: Callable[[A], A], residual: A, solution: A, steps: int, go_on: Callable[[], bool] = lambda: True
) -> None:
    """Make conjugate-gradient iterations (Hestenes & Stiefel 1952) that improve `solution` in place.

    Args:
        left: the right side of the equations, minus `normal` of the present solution. It is overwritten.
        go_on: called before each iteration; False ends it.
    """
    of_kind = solution.dtype.type
    direction, squares = residual.copy(), float(np.vdot(residual, residual))
    for _ in range(steps):
        if squares == 0 or not go_on():
            break
        image = normal(direction)
        length = of_kind(squares / float(np.vdot(direction, image)))
        solution += length * direction
        residual -= length * image
        last_squares, squares = squares, float(np.vdot(residual, residual))
        direction = residual + of_kind(squares / last_squares) * direction


def moved(x: F32, u: F32 | None) -> F32:
    """The displaced volume W x (see `recon.kernels.cpu.warp`). Without motion, x itself."""
    if u is None:
        return x
    out = np.empty_like(x)
    pull(x, u, out)
    return out


def moved_back(y: F32, u: F32 | None) -> F32:
    """The transpose Wᵀ y. Without motion, y itself."""
    if u is None:
        return y
    out = np.empty_like(y)
    push(y, u, out)
    return out
