"""The running mean of a model's parameters over the last steps.

A step follows one or two views, so that at a high rate the parameters wander about where all views would have them;
their mean does not (Polyak & Juditsky 1992).
"""

from __future__ import annotations

from dataclasses import replace

from recon.splatting.optimise import FitState


def average(state: FitState, share: float) -> None:
    """Take the parameters into their mean with this share, 0..1; the first ones are the mean."""
    if state.mean is None:
        state.mean = {name: values + 0 for name, values in state.parameters.items()}
        return
    for name, values in state.parameters.items():
        state.mean[name] += share * (values - state.mean[name])


def averaged(state: FitState) -> FitState:
    """The state with the mean of its parameters in their place, where one is kept; it shares their memory."""
    return state if state.mean is None else replace(state, parameters=state.mean)
