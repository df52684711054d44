"""Check `opposite`: compares a projection with the opposite one, or with a repetition, to find motion and change.

Parallel rays measure the same from both sides: p(angle + 180°, u) = p(angle, -u), where u is the distance from the
axis. The check keeps a projection every few degrees. It compares this projection with the mirrored projection 180°
later, or with the projection 360° later. The best fit gives the rotation axis, and the shift of the sample between the
two. The remaining difference is stated as the shift of the whole sample that would cause it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellGrid, CellView, cell_noise
from drivers.base.frame import Frame
from recon.base.setting import setting

EVERY = math.radians(5)  # radians between kept projections
MOST = 36  # number of kept projections in 180°
BESIDE = 1.01  # largest distance, in steps, of a projection from the wanted angle; a hundredth is rounding
# largest motion of the rim, in cells, within this distance; the kept projection is extrapolated with its velocity
REACH = 2.0
LATER = 8  # smallest number of projections after the kept one
LEAST_SHIFT, LEAST_REMAINDER, LEAST_AXIS = 0.05, 0.5, 0.25
"""Limits as shares of a cell, for large frames, in which a cell is many pixels wide. With these limits, one clean
simulated scan (the 44th, because of its remainder) and no measured scan is reported in tests/beamline/findings.json."""
SIGMAS = 8.0  # standard deviations of the noise that a shift must have
SHAKEN = 5.0  # standard deviations of the positions of single projections, if the sample shakes
FEWEST = 16  # smallest number of columns that both projections must share
TURNS = 6  # number of rounds of the fit
SEARCH = 0.4  # twice the largest distance of the axis from the middle, as a share of the field of view
NOISY = 2.0  # smallest remainder, as a multiple of the noise
SMOOTH = 1.0  # cells: standard deviation by which both are smoothed, so that fractions of a cell shift sharp edges well
SMOOTHER = 1 / (4 * math.pi * SMOOTH**2)  # variance of the noise after this smoothing, divided by that before
LEAST_OVERLAP = 0.3  # share of the columns

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kept:
    """A projection that is kept until the projection 180° later arrives."""

    view: CellView
    # the next projection, and later the nearest in angle so far, which gives the velocity
    after: CellView | None = None
    # turned, again: True if it was compared with the opposite projection, or with a repetition
    turned: bool = False
    again: bool = False


@dataclass(frozen=True, eq=False)
class ViewFit:
    """The fit of one projection to another, in pixels: shift across and down, its standard deviation `sigma` because of
    noise, and the remainder as an equivalent shift.

    Attributes:
        places: sum of squares of the weights that the positions of single projections have in the shift.
        unsure: possible error of extrapolating the kept projection if nothing moved; 0 if this error is within the
            limit of a change.
    """

    across: float
    down: float
    remainder: float
    sigma: float
    places: float = 2.0
    unsure: float = 0.0


@dataclass(frozen=True, eq=False)
class OppositeState:
    """Kept projections, the axis (in columns of pixels) from the first pair, and whether the check is off."""

    waiting: tuple[Kept, ...] = ()
    axis: float | None = None
    aside: bool = False


@dataclass(frozen=True)
class OppositeCheck(Logged):
    """Score: motion of the sample in pixels; or, for a change of the sample, the motion of the whole sample that would
    change the projection as much.

    Reasons for the defaults: as for `motion`, half a pixel makes double edges as wide as the resolution. If a twentieth
    of a cell is larger, this is the limit, because shifts are not known more precisely. Flat faces and coarse steps
    leave a remainder of 0.3 cells.
    """

    name: ClassVar[str] = "opposite"
    bit: ClassVar[int] = 15
    unit: ClassVar[str] = "pixels"
    meaning: ClassVar[str] = (
        "the sample moved or changed: the projection differs from the opposite projection, or "
        "from an earlier projection at the same angle"
    )

    warn: float = setting(0.5, "largest allowed motion or change of the sample, in pixels", ge=0)
    changed: float = setting(
        1.0,
        "largest allowed change of the shape of the sample. The change is stated as the shift, in pixels, of a rigid "
        "sample that would change the projection as much",
        ge=0,
    )
    axis: float = setting(1.0, "largest allowed distance of the axis from the stated position, in pixels", ge=0)

    start = OppositeState

    def look(
        self, state: OppositeState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[OppositeState]:
        view, grid = context.view, context.grid
        if view is None or grid is None or state.aside or not math.isfinite(view.angle):
            return CheckResult(state)
        if context.cone or not grid.flats:
            cone = "in a cone beam opposite projections differ even if the sample is at rest"
            reason = cone if context.cone else "there are no flats"
            advice = f"Nothing to do: opposite projections are not compared, because {reason}."
            return CheckResult(
                replace(state, aside=True), Flag(self.name, Level.INFO, frame.index, 0.0, self.warn, advice)
            )
        waiting = _with_view(state.waiting, view, frame.replaces, follows=context.follows)
        state = replace(state, waiting=waiting)
        for place, earlier in enumerate(waiting):
            is_later = earlier.after is not None and view.index - earlier.view.index >= LATER
            if is_later and (looked := self._compared(state, place, view, context)) is not None:
                return looked
        return CheckResult(replace(state, waiting=tuple(_with_nearer(earlier, view) for earlier in waiting)))

    def _compared(
        self, state: OppositeState, place: int, view: CellView, context: ScanContext
    ) -> CheckResult[OppositeState] | None:
        """Compare a projection with a kept projection. Returns None in two cases: the projections are neither opposite
        nor at the same angle; or the step that gives the velocity is so large that only a large motion would be
        visible. In the second case the pair waits for projections that are nearer in angle."""
        earlier, grid = state.waiting[place], context.grid
        assert earlier.after is not None and grid is not None
        turn, step = _folded(view.angle - earlier.view.angle), earlier.after.angle - earlier.view.angle
        tolerance, half_turn = min(BESIDE * abs(step), REACH / (0.5 * grid.shape[1])), math.copysign(math.pi, turn)
        mirrored = not earlier.turned and abs(turn - half_turn) <= tolerance
        if not mirrored and (earlier.again or abs(turn) > tolerance):
            return None
        steps = (turn - half_turn if mirrored else turn) / step
        unsure = self._unsure(earlier, earlier.after, steps, grid)
        fit = lay_on(earlier, steps, view, grid, mirrored=mirrored) if math.isfinite(unsure) else None
        if fit is None:
            return None
        fit = replace(fit, unsure=unsure)
        looked = (
            self._mirrored(state, earlier, fit, view, context)
            if mirrored
            else CheckResult(
                state, self._moved(fit, view.index, f"frame {earlier.view.index} at the same angle", context)
            )
        )
        if unsure and looked.flag is None:
            return None
        earlier = replace(earlier, turned=earlier.turned or mirrored, again=earlier.again or not mirrored)
        return replace(
            looked, state=replace(looked.state, waiting=(*state.waiting[:place], earlier, *state.waiting[place + 1 :]))
        )

    def _unsure(self, earlier: Kept, after: CellView, steps: float, grid: CellGrid) -> float:
        """Largest likely error in px of a kept projection extrapolated by some steps, see `ViewFit.unsure`.

        After a large step, other material is visible, most of all if the sample is wider than the field of view. If the
        two projections of the step differ by less than the smoothing, the error of linear extrapolation comes from the
        second derivative, which in a picture with this smoothing is at most √1.5 / SMOOTH times the first derivative.
        If the projections differ by more, or if the sample moved between them by more than the rim rotates, the
        velocity is not known, and the result is infinite.
        """
        if min(abs(steps), abs(steps - 1)) < BESIDE - 1:
            return 0.0
        fit, smooth = lay_on(earlier, 0.0, after, grid, mirrored=False), SMOOTH * grid.cell
        rim = 0.5 * grid.shape[1] * grid.cell * abs(_folded(after.angle - earlier.view.angle))
        if (
            fit is None
            or fit.remainder > smooth
            or max(abs(fit.down), abs(fit.across) - rim) > max(self.warn, LEAST_SHIFT * grid.cell, SIGMAS * fit.sigma)
        ):
            return math.inf
        unsure = math.sqrt(1.5) * abs(steps * (steps - 1)) / 2 / smooth * fit.remainder**2
        return unsure * (unsure > max(self.changed, LEAST_REMAINDER * grid.cell))

    def _mirrored(
        self, state: OppositeState, earlier: Kept, fit: ViewFit, view: CellView, context: ScanContext
    ) -> CheckResult[OppositeState]:
        assert context.grid is not None
        cell, cols = context.grid.cell, context.grid.shape[1]
        axis = (cols * cell - 1 + fit.across) / 2
        first = state.axis is None
        usual = axis if state.axis is None else state.axis
        moved = replace(fit, across=2 * (axis - usual))
        flag = self._moved(moved, view.index, f"the opposite frame {earlier.view.index}", context)
        state = state if fit.unsure else replace(state, axis=usual)
        stated = context.axis_col
        shaken = SHAKEN * math.sqrt(fit.places) * context.shake[0] / 2
        limit = max(self.axis, LEAST_AXIS * cell, shaken)
        if fit.unsure or flag is not None or not first or stated is None or abs(axis - stated) <= limit:
            return CheckResult(state, flag)
        advice = (
            f"Check the rotation axis: the opposite frames {earlier.view.index} and {view.index} show the axis at "
            f"column {axis:.1f}, but the scan states column {stated:.1f}. Either the stated column is wrong, or the "
            "sample moved between the two frames, by twice the difference of the columns."
        )
        return CheckResult(state, Flag(self.name, Level.INFO, view.index, axis - stated, self.axis, advice))

    def _moved(self, fit: ViewFit, row: int, compared_with: str, context: ScanContext) -> Flag | None:
        assert context.grid is not None
        moved, cell = math.hypot(fit.across, fit.down), context.grid.cell
        # The projections of the first pair, which gave the axis, were also displaced.
        shaken = SHAKEN * math.sqrt(2 * fit.places) * math.hypot(*context.shake)
        moves = self.warn, LEAST_SHIFT * cell, SIGMAS * fit.sigma, shaken
        limits = max(fit.unsure, *moves), max(fit.unsure, self.changed, LEAST_REMAINDER * cell)
        if moved <= limits[0] and fit.remainder <= limits[1]:
            return None
        score, limit = (moved, limits[0]) if moved > limits[0] else (fit.remainder, limits[1])
        change = (
            f"the sample moved by {fit.across:+.1f} px horizontally and {fit.down:+.1f} px vertically"
            if moved > limits[0]
            else (
                "the sample changed its shape: it shrank, bent or lost something. The frames differ as much as if "
                f"the sample had moved by {fit.remainder:.1f} px"
            )
        )
        advice = (
            f"Compare the two frames: relative to {compared_with}, {change}. If `motion` reported a jump, `beamline "
            "recon` uses only the longer part of the scan. If the sample moved or changed slowly, use `beamline recon "
            "--volumes N`, or repeat the scan faster."
        )
        return Flag(self.name, Level.WARN, row, score, limit, advice)


def _with_view(waiting: tuple[Kept, ...], view: CellView, replaces: int, *, follows: bool) -> tuple[Kept, ...]:
    """The kept projections after one more projection. It either gives the last kept projection its velocity, or is kept
    itself."""
    waiting = tuple(earlier for earlier in waiting if earlier.view.index != replaces)  # the replaced view had an alarm
    if waiting and waiting[-1].after is None:
        return (*waiting[:-1], replace(waiting[-1], after=view)) if follows else waiting[:-1]
    is_apart = all(abs(_folded(view.angle - earlier.view.angle)) >= EVERY for earlier in waiting)
    return (*waiting, Kept(view)) if len(waiting) < MOST and is_apart else waiting


def _with_nearer(earlier: Kept, view: CellView) -> Kept:
    """The kept projection, with the given one as the projection that gives its velocity, if the given one is nearer in
    angle than the present one."""
    distance_before, distance_now = (
        0.0 if each is None else abs(_folded(each.angle - earlier.view.angle)) for each in (earlier.after, view)
    )
    return replace(earlier, after=view) if (BESIDE - 1) * distance_before < distance_now < distance_before else earlier


def _folded(angle: float) -> float:
    """The same angle between -pi and pi."""
    return math.remainder(angle, 2 * math.pi)


def lay_on(earlier: Kept, steps: float, view: CellView, grid: CellGrid, *, mirrored: bool) -> ViewFit | None:
    """Best fit of the kept projection to a projection some steps later; None if the later projection has too little
    structure.

    Least squares for intensity, shift across and shift down, starting from the best whole number of cells.
    """
    assert earlier.after is not None
    first, last = grid.left, grid.right + 1
    expected = earlier.view.depth + np.float32(steps) * (earlier.after.depth - earlier.view.depth)
    if last - first < FEWEST:
        return None
    noise = cell_noise(view.depth[:, first:last], view.weight[:, first:last]) ** 2 * SMOOTHER
    now, before = (
        scipy.ndimage.gaussian_filter(depth[:, first:last].astype(np.float64), SMOOTH)
        for depth in (view.depth, expected)
    )
    if mirrored:
        before = before[:, ::-1]
    weight = np.minimum(view.weight[:, first:last], np.exp(-before)).astype(np.float64)
    across, down, gain = float(_nearest(before, now)), 0.0, 0.0
    cols = now.shape[1]
    for _ in range(TURNS):
        fitted = scipy.ndimage.shift(before, (down, across), order=3, mode="nearest")
        cut = math.ceil(abs(across)) + 1
        inside = np.s_[:, max(1, cut if across > 0 else 1) : cols - max(1, cut if across < 0 else 1)]
        rows, columns = np.gradient(fitted) if len(now) > 1 else (np.zeros_like(fitted), np.gradient(fitted, axis=1))
        basis = np.stack([np.ones_like(fitted), -columns, -rows])[:, *inside].reshape(3, -1)
        if basis.shape[1] < LEAST_OVERLAP * now.size:
            return None
        w = weight[inside].ravel()
        residual = (now - fitted)[inside].ravel()
        normal = (basis * w) @ basis.T
        determined = np.diag(normal)[1:] > NOISY * noise * len(w)  # a sample with equal rows shows no shift down
        if not determined[0]:
            return None
        if not determined[1]:
            basis[2], normal[2], normal[:, 2] = 0.0, 0.0, 0.0
        normal += np.diag(1e-9 * np.diag(normal) + 1e-12)
        gain, more_across, more_down = (float(x) for x in np.linalg.solve(normal, (basis * w) @ residual))
        across, down = across + more_across, down + more_down
    residual = residual - basis.T @ np.array([gain, more_across, more_down])
    squares = float((w * residual**2).mean())
    structure = float((w * (basis[1] ** 2 + basis[2] ** 2)).mean()) / 2
    own = noise * (1 + (1 - steps) ** 2 + steps**2)
    remainder = math.sqrt(max(squares - own, 0.0) / structure) if squares > NOISY * own else 0.0
    sigma = math.sqrt(own / SMOOTHER / float(np.diag(normal)[1:][determined].min()))
    # Both projections begin at `first`: after mirroring about the middle of the frame, their columns are at other
    # positions.
    offset = first + last - grid.shape[1] if mirrored else 0
    places = 1 + (1 - steps) ** 2 + steps**2
    return ViewFit((across + offset) * grid.cell, down * grid.cell, remainder * grid.cell, sigma * grid.cell, places)


def _nearest(before: Reals, now: Reals) -> int:
    """Shift in cells across with which `before` agrees best with `now`: the mean square of the difference in the shared
    columns is smallest."""
    cols = now.shape[1]
    reach = int(SEARCH * cols)
    strips = np.add.reduceat(np.stack([before, now]), np.arange(0, len(now), max(1, len(now) // 16)), axis=1)
    first, two = strips - strips.mean(axis=(1, 2), keepdims=True)
    best, least = 0, math.inf
    for move in range(-reach, reach + 1):
        a, b = (first[:, : cols - move], two[:, move:]) if move >= 0 else (first[:, -move:], two[:, : cols + move])
        variance = float(np.var(a - b))
        if variance < least:
            best, least = move, variance
    return best
