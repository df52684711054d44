"""Effects of refraction and scattering in the sample, and of loose particles in the beam."""

from functools import partial

from simulators.effects import Domain, EffectRow

_deflected, _phase_fringes = (
    partial(EffectRow, module=f"{__name__}.{name}") for name in ("deflected", "phase_fringes")
)
EFFECTS = {
    "floaters": _deflected(
        Domain.OPTICAL_DEPTH, "loose particles far from the axis are in the field of view in a few projections"
    ),
    "phase_fringes": _phase_fringes(
        Domain.OPTICAL_DEPTH, "edges get bright rims (phase fringes) by propagation to the detector"
    ),
    "scatter": _deflected(
        Domain.PHOTONS,
        "photons that the sample deflects hit other pixels",
        frozenset({"beam_profile", "beam_bend", "narrow_field"}),
        "the sample scatters the light that reaches it",
    ),
}
