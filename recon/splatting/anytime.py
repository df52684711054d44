"""Rates and mean of a fit whose number of steps is not known.

The rates fall as 1 / (1 + t / 60) with the steps t, and the model is the mean of the parameters over the last quarter
of them. A step follows one or two views, so at a high rate the parameters wander about the point where all views would
have them. Their mean does not (Polyak & Juditsky 1992). After any number of steps the mean is about as good as a fit
whose rates were planned to end there (docs/notes/performance.md, "Streaming").
"""

from __future__ import annotations

import math
from dataclasses import fields, replace

from recon.splatting.density_control import DensityPolicy
from recon.splatting.optimise import FitState
from recon.splatting.settings import FitSettings

HALF = 60.0  # steps after which the rates are half of the first ones
_WINDOW = 0.25  # share of the steps over which the mean is taken
_EVERY = 4  # steps between two of the mean

WHILE_VIEWS_COME = FitSettings(decay=0.02, policy=DensityPolicy(start=0.0, stop=2.0))
"""The rates of a fit to all views, to a lower end; density control at any rate, as far as the rounds make room."""


def while_views_come(settings: FitSettings) -> FitSettings:
    """The same, with what a caller's settings have other than the defaults."""
    usual = FitSettings()
    chosen = {
        f.name: value for f in fields(FitSettings) if (value := getattr(settings, f.name)) != getattr(usual, f.name)
    }
    if isinstance(policy := chosen.get("policy"), DensityPolicy):  # how many steps there will be is not known
        chosen["policy"] = replace(policy, start=0.0, stop=2.0)
    return replace(WHILE_VIEWS_COME, **chosen)


def fallen(steps: int, settings: FitSettings) -> float:
    """How far the rates have come after so many steps on their logarithmic way to the last ones, 0..1.

    Rates that are lower from the start fall as much later.
    """
    half = HALF * WHILE_VIEWS_COME.pace / settings.pace
    return min(1.0, math.log1p(steps / half) / max(-math.log(settings.decay), 1e-9))


def average(state: FitState, since: int) -> None:
    """Take the parameters into their mean, at every fourth step; the first ones are the mean.

    Args:
        since: the step that the last quarter is counted from.
    """
    if state.step % _EVERY:
        return
    if state.mean is None:
        state.mean = {name: values + 0 for name, values in state.parameters.items()}
        return
    share = _EVERY / (_EVERY + _WINDOW * (state.step - since))
    for name, values in state.parameters.items():
        state.mean[name] += share * (values - state.mean[name])


def averaged(state: FitState) -> FitState:
    """The state with the mean of its parameters in their place, where one is kept; it shares their memory."""
    return state if state.mean is None else replace(state, parameters=state.mean)
