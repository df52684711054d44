"""Reconstruction within a time: choose method and settings by what they take on this machine, and end in time."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from beamline.core.durations import MachineSpeed
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.run import binned, run_on
from recon.assess.time_model import Choice, Speeds, duration_text, plans
from recon.auto import LEFT, ROWS, part_of, predicts_best
from recon.base.method import DataUse, Method, ReconProblem, Reconstruction, RunControl
from recon.base.volume import Grid
from recon.base.work import Rates
from recon.methods import with_settings
from recon.splatting.fit_method import FitMethod
from recon.splatting.in_time import speeds_of
from recon.splatting.initialise import default_count
from recon.voxels.direct import has_direct_method

_RESERVE = 0.02  # share of the budget for unmeasured work
_TRIAL_ROWS = (ROWS, ROWS // 2, ROWS // 4)
# Share of the time that a trial may take by prediction; in fact it may take a quarter more.
_TRIAL, _TRIAL_SLACK = 0.375, 1.25
_OF_TRIALS = 0.4  # of the time of a method on voxels, that trials of its weight may take
_LEVEL = 0.3  # dB: by the curves of four scans such methods are level


@dataclass(frozen=True, eq=False)
class _Budget:
    """A budget in use: the time left, and the choices that it allows; the methods by preference."""

    seconds: float
    begin: float
    now: Callable[[], float]
    methods: Mapping[str, Method]
    speeds: Speeds
    largest_binning: int

    @property
    def seconds_left(self) -> float:
        return self.seconds - (self.now() - self.begin)

    def choices(self, share: float = 1.0, name: str | None = None) -> list[Choice]:
        """The best choice of each method (or of one) within this share of the time left.

        If no time is left: the cheapest, which is the one for the shortest time.
        """
        available = max(share * self.seconds_left, sys.float_info.min)
        return plans(available, self.speeds, self.largest_binning, self.methods if name is None else [name])

    def preferred(self, choices: Sequence[Choice]) -> Choice:
        """The most preferred method whose expected gain is level with the largest."""
        level = [c for c in choices if c.gain >= choices[0].gain - _LEVEL]
        order = list(self.methods)
        return min(level, key=lambda c: order.index(c.method))

    def method(self, choice: Choice, default_count: int) -> Method:
        return with_settings(self.methods[choice.method], choice.settings(default_count))


def within(
    budget: float,
    prepared: PreparedProjections,
    methods: Sequence[Method],
    seed: int,
    control: RunControl,
    warn: Warn,
    largest: int | None = None,
    rates: Rates | None = None,
) -> tuple[Reconstruction, PreparedProjections]:
    """Reconstruct within `budget` seconds by the clock of `control`.

    For each method the settings that the time suffices for follow from its measured curves. Several methods are tried
    on some rows, and the one that predicts views held out best gets the time that is left. Where trials would take more
    than 0.375 of the time, the first method with the highest expectation is taken. Placing of Gaussians is run and
    timed before the fit gets what is left, and filling is timed on a slab. Where even the cheapest choice will be late,
    `warn` gets a warning before the work.

    Args:
        methods: to choose from, with measured curves, by preference; the choice sets their steps and Gaussians.
        largest: binning; None: any.
        rates: of this machine; None: measured, or those kept.

    Returns:
        The volume, whose settings say what was chosen and how long it should have taken; its seconds are of everything
        but what is measured once on a machine. Then the views that it used, with binned pixels if the choice bins them.

    Raises:
        ValueError: the views cannot be reconstructed.
    """
    now, geometry = control.now, prepared.geometry
    speeds = speeds_of(geometry, prepared.box, rates or MachineSpeed())
    begin = now()  # what is measured once on a machine is no part of a budget, as kernels that are compiled once
    unbinned = default_count(geometry, geometry.sample_pitch)  # the curves count in these
    direct = has_direct_method(geometry)
    taking = {method.name: method for method in methods if direct or not method.traits.direct}
    if prepared.is_wide:  # the few sweeps after a fit leave the offset of the middle open: 4 dB behind FBP
        taking = {name: method for name, method in taking.items() if not method.traits.any_grid} or taking
    plan = _Budget(budget, begin, now, taking, speeds, largest or min(geometry.detector_shape))
    choices = plan.choices()
    choice, because = choices[0], ""
    late = choice.seconds - plan.seconds_left
    if 0 < late < math.inf and not math.isfinite(choice.gain):
        warn(
            f"{duration_text(budget)} are too few for this scan: the cheapest choice, {_named(choice)}, will be about "
            f"{duration_text(late)} late."
        )
    if len(choices) > 1:
        choice, because = _chosen(plan, choices, prepared, seed, control)
    prepared = binned(prepared, choice.binning)
    method = plan.method(choice, unbinned)
    end = begin + budget * (1 - _RESERVE)
    result = _run(method, prepared, seed, end, control)
    return _marked(result, choice, speeds, because, budget, now() - begin), prepared


def _marked(
    result: Reconstruction, choice: Choice, speeds: Speeds, because: str, budget: float, seconds: float
) -> Reconstruction:
    """The result with what was chosen and why, what its parts were expected to take, and what all of it took."""
    settings = {
        "budget": budget,
        "budget_used": seconds,
        "chosen_method": result.method,
        "chosen_because": because,
        "chosen_binning": choice.binning,
        "chosen_share": choice.share,
        "expected_steps": choice.steps,
        "expected_gain_db": choice.gain,
        "expected_s": choice.seconds,
        "measured_fbp_s": speeds.fbp,
        "measured_start_s": speeds.start,
        "measured_step_s": speeds.step,
        "measured_fill_s": speeds.fill,
        "measured_sweep_s": speeds.sweep,
    }
    why = f"; {because}" if because else ""
    chosen = f"{_named(choice, result)}: {duration_text(seconds)} of {duration_text(budget)}{why}"
    return replace(result, seconds=seconds, chosen=chosen, settings={**result.settings, **settings})


def _chosen(
    plan: _Budget, choices: Sequence[Choice], prepared: PreparedProjections, seed: int, control: RunControl
) -> tuple[Choice, str]:
    """The method that predicts views of some rows best, with the settings that the rest of the time suffices for."""
    listed = ", ".join(f"{c.method} {c.gain:.1f}" for c in choices)
    expected = f"expected by other scans, dB above FBP: {listed}; nothing was tried: "
    by_curves = plan.preferred(choices)
    problem = _problem_of(prepared, seed)
    # Those that take no time first, then the most promising ones, since the time may end before the last.
    tried = sorted((c for c in plan.choices(1 - _TRIAL) if c.binning == 1), key=lambda c: bool(c.counted))
    if len(tried) < 2:
        return by_curves, f"{expected}too little time"
    seconds = _TRIAL * plan.seconds_left
    for rows in _TRIAL_ROWS:
        part, where = part_of(problem, rows)
        if part is None:
            return by_curves, expected + where
        share = math.prod(part.grid.shape) / math.prod(problem.grid.shape)
        if share * sum(c.seconds for c in tried) <= seconds:
            break
    else:
        return by_curves, f"{expected}the scan has too few rows for a trial in this time"
    count = default_count(part.geometry, part.geometry.sample_pitch)
    trial = RunControl(control.stop, now=control.now).by(control.now() + _TRIAL_SLACK * seconds)
    liked = sorted(tried, key=lambda c: list(plan.methods).index(c.method))
    order = [liked.index(c) for c in tried]
    at, residuals = predicts_best(part, [plan.method(c, count) for c in liked], trial, order=order, least_gain=0.0)
    if at is None:
        return plan.preferred(plan.choices()), f"{expected}too little time"
    return plan.choices(name=liked[at].method)[0], f"trials on {where}, {LEFT}: {residuals}"


def _problem_of(prepared: PreparedProjections, seed: int) -> ReconProblem:
    geometry, use = prepared.geometry, DataUse(prepared.ray_weights())
    return ReconProblem(prepared.projections.data, geometry, prepared.box, use, seed, "cpu", prepared.is_wide)


def _run(method: Method, prepared: PreparedProjections, seed: int, end: float, control: RunControl) -> Reconstruction:
    """The volume of a method by `end`."""
    data, geometry, now = prepared.projections.data, prepared.geometry, control.now
    if isinstance(method, FitMethod):
        method = method.in_time(data, geometry, seed, lambda: end - now())
    trials = control.stop.by(now() + _OF_TRIALS * (end - now()), now)
    return run_on(method, prepared, Grid.matching(geometry), seed, replace(control.by(end), stop_trials=trials))


def _named(choice: Choice, result: Reconstruction | None = None) -> str:
    text = choice.method
    if result is not None and result.history:
        text += f", {result.history[-1].step} {choice.counted}"
    if result is not None and choice.is_gaussian_fit:
        text += f" from {result.started_from} Gaussians"
    return text + (f", binned {choice.binning} x {choice.binning}" if choice.binning > 1 else "")
