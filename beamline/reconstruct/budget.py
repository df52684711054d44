"""Reconstruction within a time: choose method and settings by what they take on this machine, and end in time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.run import binned, run_on
from recon.assess.time_model import USEFUL, duration_text
from recon.auto import LEFT, ROWS, part_of, predicts_best
from recon.base.geometry import Geometry
from recon.base.method import Clock, DataUse, Method, ReconProblem, Reconstruction, RunControl
from recon.base.volume import Grid
from recon.forecast import Pace, Timing
from recon.methods import with_settings
from recon.splatting.fit_method import FitMethod
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.voxels.direct import has_direct_method

_RESERVE = 0.02  # share of the budget for unmeasured work
_TRIAL_ROWS = (ROWS, ROWS // 2, ROWS // 4)
# Share of the time that a trial may take by prediction; in fact it may take a quarter more.
_TRIAL, _TRIAL_SLACK = 0.375, 1.25
_OF_TRIALS = 0.4  # of the time of a method on voxels, that trials of its weight may take
_BINNINGS = 1, 2, 4, 8
_TIMED_VOXELS = 2**17  # of the part that is timed, which counts in the budget


@dataclass(frozen=True)
class TimedChoice:
    """A method with the settings that some time suffices for.

    Attributes:
        steps: as its setting of `USEFUL` counts them; 0: it has none.
        binning: of detector pixels, on top of the selection's.
        seconds: expected.
    """

    method: str
    steps: int
    binning: int
    seconds: float


def choices(paces: Mapping[str, Pace], seconds: float, largest: int) -> list[TimedChoice]:
    """The methods that so many seconds suffice for, with as many useful steps as they do; the preferred one first.

    Pixels are binned only where the time suffices for no method on all of them: FBP of all is better than any method of
    binned ones. If no binning up to `largest` is quick enough, the quickest choice alone.
    """
    binnings = [n for n in _BINNINGS if n <= max(1, largest)]
    for binning in binnings:
        some = [_longest(name, pace, binning, seconds) for name, pace in paces.items()]
        if able := [each for each in some if each.seconds <= seconds]:
            return sorted(able, key=lambda each: list(USEFUL).index(each.method), reverse=True)
    return [min((_longest(name, paces[name], n, 0.0) for name in paces for n in binnings), key=lambda c: c.seconds)]


def _longest(name: str, pace: Pace, binning: int, seconds: float) -> TimedChoice:
    """The choice of as many steps as the time suffices for, of the least useful number if it does not."""
    useful = USEFUL[name]
    fixed, each = pace.fixed / binning**3, pace.each / binning ** (2 if name == R2.name else 3)
    most = int((seconds - fixed) / each) if each > 0 else useful.most
    steps = max(useful.least, min(most, useful.most))
    return TimedChoice(name, steps, binning, fixed + steps * each)


def paces_of(methods: Iterable[Method], geometry: Geometry, grid: Grid, now: Clock) -> dict[str, Pace]:
    """Seconds of each of these methods with useful numbers of steps, by name, from steps that are timed here.

    Raises:
        ValueError: none takes these views.
    """
    timing, paces, refused = Timing(geometry, grid, now, _TIMED_VOXELS), dict[str, Pace](), list[str]()
    for method in methods:
        if method.name in USEFUL:
            try:
                paces[method.name] = timing.whole_pace(method)
            except ValueError as error:
                refused.append(f"{method.name}: {error}")
    if not paces:
        raise ValueError("; ".join(refused) or "no method has steps or iterations that the seconds could limit")
    return paces


@dataclass(frozen=True, eq=False)
class _Budget:
    """A budget in use: when it ends, and what each method takes."""

    end: float
    now: Clock
    methods: Mapping[str, Method]
    paces: Mapping[str, Pace]
    largest: int

    @property
    def seconds_left(self) -> float:
        return self.end - self.now()

    def choices(self, share: float = 1.0, name: str | None = None) -> list[TimedChoice]:
        """`choices` of all methods (or of one) within this share of the time left."""
        paces = self.paces if name is None else {name: self.paces[name]}
        return choices(paces, share * self.seconds_left, self.largest)

    def method(self, choice: TimedChoice, default_count: int) -> Method:
        """The method with the settings of the choice, for a volume of so many Gaussians by default."""
        counted, method = USEFUL[choice.method].setting, self.methods[choice.method]
        settings = {counted: choice.steps} if counted else {}
        if choice.method == R2.name:
            settings["gaussians"] = max(1, round(default_count / choice.binning**3))
        return with_settings(method, settings)


def within(
    budget: float,
    prepared: PreparedProjections,
    methods: Sequence[Method],
    seed: int,
    control: RunControl,
    warn: Warn,
    largest: int | None = None,
) -> tuple[Reconstruction, PreparedProjections]:
    """Reconstruct within `budget` seconds by the clock of `control`.

    Some steps of each method are timed on a part of the views. Then several methods are tried on some rows, and the one
    that predicts views held out best gets the time that is left. Where trials would take more than 0.375 of the time,
    the method is taken that is best on other scans. Placing of Gaussians is run and timed before the fit gets what is
    left, and filling is timed on a slab. Where even the cheapest choice will be late, `warn` gets a warning before the
    work.

    Args:
        methods: to choose from; those of `USEFUL` are. The choice sets their steps and Gaussians.
        largest: binning; None: any.

    Returns:
        The volume, whose settings say what was chosen and how long it should have taken. Then the views that it used,
        with binned pixels if the choice bins them.

    Raises:
        ValueError: the views cannot be reconstructed.
    """
    now, geometry, begin = control.now, prepared.geometry, control.now()
    unbinned = default_count(geometry, geometry.sample_pitch)
    direct = has_direct_method(geometry)
    taking = {method.name: method for method in methods if direct or not method.traits.direct}
    if prepared.is_wide:  # the few sweeps after a fit leave the offset of the middle open: 4 dB behind FBP
        taking = {name: method for name, method in taking.items() if not method.traits.any_grid} or taking
    paces = paces_of(taking.values(), geometry, prepared.box, now)
    plan = _Budget(begin + budget, now, taking, paces, largest or min(geometry.detector_shape))
    able = plan.choices()
    choice, because = able[0], ""
    if (late := choice.seconds - plan.seconds_left) > 0:
        warn(
            f"{duration_text(budget)} are too few for this scan: the cheapest choice, {_named(choice)}, will be about "
            f"{duration_text(late)} late."
        )
    elif len(able) > 1:
        choice, because = _chosen(plan, able, prepared, seed, control)
    prepared = binned(prepared, choice.binning)
    method = plan.method(choice, unbinned)
    end = begin + budget * (1 - _RESERVE)
    result = _run(method, prepared, seed, end, control)
    seconds = now() - begin
    settings = {
        "budget": budget,
        "budget_used": seconds,
        "chosen_method": result.method,
        "chosen_because": because,
        "chosen_binning": choice.binning,
        "expected_steps": choice.steps,
        "expected_s": choice.seconds,
    }
    why = f"; {because}" if because else ""
    chosen = f"{_named(choice, result)}: {duration_text(seconds)} of {duration_text(budget)}{why}"
    return replace(result, seconds=seconds, chosen=chosen, settings={**result.settings, **settings}), prepared


def _chosen(
    plan: _Budget, able: Sequence[TimedChoice], prepared: PreparedProjections, seed: int, control: RunControl
) -> tuple[TimedChoice, str]:
    """The method that predicts views of some rows best, with the settings that the rest of the time suffices for."""
    untried = f"{able[0].method} was best on other scans; nothing was tried: "
    problem = _problem_of(prepared, seed)
    # Those that take no time first, then the most promising ones, since the time may end before the last.
    tried = sorted(
        (c for c in plan.choices(1 - _TRIAL) if c.binning == 1), key=lambda c: bool(USEFUL[c.method].setting)
    )
    if len(tried) < 2:
        return able[0], f"{untried}too little time"
    seconds = _TRIAL * plan.seconds_left
    for rows in _TRIAL_ROWS:
        part, where = part_of(problem, rows)
        if part is None:
            return able[0], untried + where
        share = math.prod(part.grid.shape) / math.prod(problem.grid.shape)
        if share * sum(c.seconds for c in tried) <= seconds:
            break
    else:
        return able[0], f"{untried}the scan has too few rows for a trial in this time"
    count = default_count(part.geometry, part.geometry.sample_pitch)
    trial = RunControl(control.stop, now=control.now).by(control.now() + _TRIAL_SLACK * seconds)
    liked = sorted(tried, key=lambda c: list(plan.methods).index(c.method))
    order = [liked.index(c) for c in tried]
    at, residuals = predicts_best(part, [plan.method(c, count) for c in liked], trial, order=order, least_gain=0.0)
    if at is None:
        return plan.choices()[0], f"{untried}too little time"
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


def _named(choice: TimedChoice, result: Reconstruction | None = None) -> str:
    text = choice.method
    if result is not None and result.history:
        text += f", {result.history[-1].step} {USEFUL[choice.method].setting}"
    if result is not None and choice.method == R2.name:
        text += f" from {result.started_from} Gaussians"
    return text + (f", binned {choice.binning} x {choice.binning}" if choice.binning > 1 else "")
