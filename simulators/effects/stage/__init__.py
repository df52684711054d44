"""Errors of the stage, and of the sample on it."""

from functools import partial

from simulators.effects import Domain, EffectRow

_Row = partial(EffectRow, module=f"{__name__}.errors")
EFFECTS = {
    "encoder_error": _Row(Domain.MOTION, "the stage's angle differs from its encoder's reading"),
    "backlash": _Row(Domain.MOTION, "after a reversal the stage lags behind its encoder (backlash)"),
    "stage_wobble": _Row(Domain.MOTION, "the rotation axis wobbles in tilt as the stage rotates"),
    "runout": _Row(Domain.MOTION, "the rotation axis moves sideways as the stage rotates"),
    "jump": _Row(
        Domain.MOTION,
        "the sample slips on the stage once",
        frozenset({"encoder_error", "backlash", "stage_wobble", "runout"}),
        "errors of the stage depend on its angle, and the sample slips on the stage",
    ),
}
