"""Order: which effects cannot come before which within a domain, for light and charge go one way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Behind:
    """What an effect comes behind, and why; only what would give another frame the other way round."""

    names: frozenset[str]
    why: str


_CHARGE = frozenset({"dark_current", "hot_pixels", "zingers"})
BEHIND: Mapping[str, Behind] = MappingProxyType(
    {
        "jump": Behind(
            frozenset({"encoder_error", "backlash", "stage_wobble", "runout"}),
            "errors of the stage go by the stage's angle, and the sample slips on the stage",
        ),
        "scatter": Behind(frozenset({"beam_profile", "narrow_field"}), "the sample scatters the light that it gets"),
        "scintillator_blur": Behind(
            frozenset({"beam_profile", "narrow_field", "black_band"}),
            "the scintillator blurs whatever arrives at it",
        ),
        "quantum_efficiency": Behind(frozenset({"scatter"}), "stray light is detected like any other"),
        "prnu": Behind(
            frozenset({"scatter", "scintillator_blur"}), "pixels differ in how they see light that is spread already"
        ),
        "saturation": Behind(_CHARGE, "a pixel is full whatever fills it"),
        "dead_pixels": Behind(_CHARGE, "dead pixels stay as they are whatever falls on them"),
    }
)


def problem(earlier: str, later: str) -> str:
    """Why two effects of one domain cannot come in this order; empty where they can."""
    behind = BEHIND.get(earlier)
    if behind is None or later not in behind.names:
        return ""
    return f"effect {later!r} must come before {earlier!r}: {behind.why}"
