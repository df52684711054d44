"""Anytime: rates and mean of a fit with an unknown number of steps.

The rates fall as 1 / (1 + t / 60) with the steps t, and the model is the mean of the parameters over the last quarter
of them. A step uses one or two views, so at a high rate the parameters wander about the optimum of all views. Their
mean does not (Polyak & Juditsky 1992). After any number of steps the mean is about as good as a fit whose rates
were planned to end there (docs/notes/performance.md, "Streaming").
"""

from __future__ import annotations

import math
from dataclasses import fields, replace

from recon.splatting.density_control import DensityPolicy
from recon.splatting.optimise import FitState, settle
from recon.splatting.settings import FitSettings

HALF = 60.0  # steps after which the rates are half of the first ones
_WINDOW = 0.25  # share of the steps over which the mean is taken
_EVERY = 4  # steps between two terms of the mean

WHILE_VIEWS_COME = FitSettings(decay=0.02, policy=DensityPolicy(start=0.0, stop=2.0))
"""The rates of a fit to all views, with a lower end; density control in every round, within the round's limit."""


def while_views_come(settings: FitSettings) -> FitSettings:
    """The same, with the caller's settings where these differ from the defaults."""
    usual = FitSettings()
    chosen = {
        f.name: value for f in fields(FitSettings) if (value := getattr(settings, f.name)) != getattr(usual, f.name)
    }
    if isinstance(policy := chosen.get("policy"), DensityPolicy):  # the number of steps to come is not known
        chosen["policy"] = replace(policy, start=0.0, stop=2.0)
    return replace(WHILE_VIEWS_COME, **chosen)


def fallen(steps: int, settings: FitSettings) -> float:
    """Share, 0..1, of the rates' logarithmic way to the last ones after so many steps.

    Rates that are lower from the start fall as much later.
    """
    half = HALF * WHILE_VIEWS_COME.pace / settings.pace
    return min(1.0, math.log1p(steps / half) / max(-math.log(settings.decay), 1e-9))


def average(state: FitState, since: int) -> None:
    """Add the parameters to their mean, at every fourth step; the first ones start it.

    Args:
        since: the step that the last quarter is counted from.
    """
    if state.step % _EVERY:
        return
    settle(state)
    if state.mean is None:
        state.mean = {name: values + 0 for name, values in state.parameters.items()}
        return
    share = _EVERY / (_EVERY + _WINDOW * (state.step - since))
    for name, values in state.parameters.items():
        state.mean[name] += share * (values - state.mean[name])


def averaged(state: FitState) -> FitState:
    """The state with its parameters replaced by their running mean, if it has one; nothing is copied."""
    return state if state.mean is None else replace(state, parameters=state.mean)
