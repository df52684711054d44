"""Catalogue: every effect by name, with its domain and its place in it; no effect's module is imported here.

The module of effect `photon_noise` is simulators.effects.photon_noise, and its class PhotonNoise. It is imported when a
scene names the effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from types import MappingProxyType
from typing import Any

from recon.base.registry import Registry


class Domain(IntEnum):
    """The quantity that an effect acts on, in the order of physics."""

    MOTION = 0
    OPTICAL_DEPTH = 1
    PHOTONS = 2
    ELECTRONS = 3
    COUNTS = 4

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class EffectRow:
    """An effect of the catalogue.

    Attributes:
        domain: what it acts on.
        summary: what happens, in half a sentence.
        follows: effects of the same domain that must come before it, because another order changes the frame.
        reason: why they come before it.
    """

    domain: Domain
    summary: str
    follows: frozenset[str] = frozenset()
    reason: str = ""


FINAL = frozenset({"photon_noise", "read_noise", "adc"})
"""Effects that end their domain: nothing of that domain may follow."""
_BEAM = frozenset({"beam_profile", "beam_bend", "narrow_field"})
_CHARGE = frozenset({"dark_current", "hot_pixels", "zingers"})
_OURS: Mapping[str, EffectRow] = MappingProxyType(
    {
        "motion_blur": EffectRow(Domain.MOTION, "the sample turns during the exposure"),
        "rolling_shutter": EffectRow(Domain.MOTION, "lower rows are exposed later, when the sample has turned further"),
        "afterglow": EffectRow(Domain.MOTION, "the scintillator still emits light of earlier moments"),
        "encoder_error": EffectRow(Domain.MOTION, "the stage's angle differs from its encoder's reading"),
        "backlash": EffectRow(Domain.MOTION, "after turning backwards the stage lags behind its encoder"),
        "stage_wobble": EffectRow(Domain.MOTION, "the rotation axis tilts as the stage turns"),
        "runout": EffectRow(Domain.MOTION, "the rotation axis wanders as the stage turns"),
        "jump": EffectRow(
            Domain.MOTION,
            "the sample slips on the stage once",
            frozenset({"encoder_error", "backlash", "stage_wobble", "runout"}),
            "errors of the stage depend on the stage's angle, and the sample slips on the stage",
        ),
        "pixel_area": EffectRow(Domain.OPTICAL_DEPTH, "a pixel counts the light on its whole area"),
        "floaters": EffectRow(Domain.OPTICAL_DEPTH, "crumbs far from the axis are in the field of view in a few views"),
        "phase_fringes": EffectRow(Domain.OPTICAL_DEPTH, "edges get bright rims by propagation to the detector"),
        "harmonics": EffectRow(Domain.OPTICAL_DEPTH, "some photons have three times the energy"),
        "beam_hardening": EffectRow(Domain.OPTICAL_DEPTH, "soft energies of the beam are absorbed before hard ones"),
        "beam_profile": EffectRow(Domain.PHOTONS, "the beam is brightest in the middle, striped, and wanders"),
        "beam_bend": EffectRow(Domain.PHOTONS, "the open beam of the views is not that of the flats"),
        "ring_current": EffectRow(Domain.PHOTONS, "the ring current decays and is topped up"),
        "ghost": EffectRow(Domain.PHOTONS, "a fog-like change of the light crosses the frame in a few views"),
        "black_band": EffectRow(Domain.PHOTONS, "a slit darkens a band at the left side"),
        "narrow_field": EffectRow(Domain.PHOTONS, "the beam is narrower than the sample"),
        "lost_beam": EffectRow(Domain.PHOTONS, "for a time there is no light, or less of it"),
        "scatter": EffectRow(
            Domain.PHOTONS,
            "photons that the sample deflects arrive elsewhere",
            _BEAM,
            "the sample scatters the light that reaches it",
        ),
        "scintillator_blur": EffectRow(
            Domain.PHOTONS,
            "scintillator and optics blur, and glare far away",
            _BEAM | {"black_band"},
            "the scintillator blurs all light that reaches it",
        ),
        "flat_structure": EffectRow(Domain.PHOTONS, "dust and scratches on scintillator and optics"),
        "quantum_efficiency": EffectRow(
            Domain.PHOTONS,
            "the sensor detects a share of the photons",
            frozenset({"scatter"}),
            "stray light is detected like any other",
        ),
        "prnu": EffectRow(
            Domain.PHOTONS,
            "pixels differ in how much light they detect",
            frozenset({"scatter", "scintillator_blur"}),
            "pixels differ in their response to light that is spread already",
        ),
        "photon_noise": EffectRow(Domain.PHOTONS, "photons arrive at random"),
        "dark_current": EffectRow(Domain.ELECTRONS, "electrons that arise without light"),
        "hot_pixels": EffectRow(Domain.ELECTRONS, "a few pixels have a large dark current"),
        "zingers": EffectRow(Domain.ELECTRONS, "stray X-rays hit the sensor"),
        "saturation": EffectRow(
            Domain.ELECTRONS, "a pixel holds no more than its full well", _CHARGE, "charge of any origin fills a pixel"
        ),
        "dead_pixels": EffectRow(
            Domain.ELECTRONS, "a few pixels do not respond to light", _CHARGE, "dead pixels hold a constant charge"
        ),
        "read_noise": EffectRow(Domain.ELECTRONS, "noise of the readout"),
        "offset": EffectRow(Domain.COUNTS, "the digital bias"),
        "adc": EffectRow(Domain.COUNTS, "a converter of fewer bits, or a nonlinear one"),
    }
)


def _fitting(name: str, effect: type[Any]) -> type[Any]:
    """The class of another package's effect, which states its own domain, summary and place."""
    if effect.name != name:
        raise ValueError(f"its class calls itself {effect.name!r}; expected the entry point's name")
    _entry_of(effect)
    return effect


def _entry_of(effect: type[Any]) -> EffectRow:
    summary, follows = (effect.__doc__ or "").partition("\n")[0], frozenset(getattr(effect, "follows", ()))
    return EffectRow(Domain(effect.domain), summary, follows, getattr(effect, "reason", "its package says so"))


_PLUGGED: Registry[type[Any]] = Registry("effect", {}, _fitting, reserved=_OURS)
CATALOGUE: Mapping[str, EffectRow] = MappingProxyType(
    {**_OURS, **{name: _entry_of(effect) for name, effect in _PLUGGED.items()}}
)


def order_error(earlier: str, later: str) -> str:
    """Why two effects of one domain cannot come in this order; "" if they can."""
    entry = CATALOGUE.get(earlier)
    if entry is None or later not in entry.follows:
        return ""
    return f"effect {later!r} must come before {earlier!r}: {entry.reason}"


def load_effect(name: str) -> type[Any]:
    """The class (see chain.AnyEffect) of an effect; this imports its module."""
    if name in _PLUGGED:
        return _PLUGGED[name]
    module = import_module(f"simulators.effects.{name}")
    return getattr(module, name.title().replace("_", ""))
