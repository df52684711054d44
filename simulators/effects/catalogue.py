"""Catalogue: every effect by name, with its domain and its place in the order; no effect's module is imported here.

The module of effect `photon_noise` is simulators.effects.sensor, and its class PhotonNoise. It is imported when a scene
names the effect. EFFECTS of a folder contains the effects of this folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import Any

from recon.base.registry import Registry, in_folders
from simulators.effects import Domain, EffectRow

__all__ = ["CATALOGUE", "FINAL", "Domain", "EffectRow", "load_effect", "order_error"]

FINAL = frozenset({"photon_noise", "read_noise", "adc"})
"""Effects that end their domain: no other effect of this domain may follow."""
_CHARGE = frozenset({"dark_current", "hot_pixels", "zingers"})
_exposure, _sensor = (partial(EffectRow, module=f"simulators.effects.{name}") for name in ("exposure", "sensor"))
_OURS: Mapping[str, EffectRow] = MappingProxyType(
    {
        "motion_blur": _exposure(Domain.MOTION, "the sample turns during the exposure"),
        "pixel_area": _exposure(Domain.OPTICAL_DEPTH, "a pixel measures the mean intensity over its area"),
        "beam_profile": _exposure(Domain.PHOTONS, "the beam is brightest in the middle, has stripes, and drifts"),
        "quantum_efficiency": _sensor(
            Domain.PHOTONS,
            "the sensor detects only a share of the photons",
            frozenset({"scatter"}),
            "the detector counts stray light like other light",
        ),
        "photon_noise": _sensor(Domain.PHOTONS, "photons arrive at random"),
        "dark_current": _sensor(Domain.ELECTRONS, "electrons that are generated without light (dark current)"),
        "saturation": _sensor(
            Domain.ELECTRONS,
            "a pixel holds at most the charge of its full well",
            _CHARGE,
            "charge of any origin fills a pixel",
        ),
        "read_noise": _sensor(Domain.ELECTRONS, "readout noise of the camera"),
        "offset": _sensor(Domain.COUNTS, "the digital offset of the camera"),
        "adc": _sensor(Domain.COUNTS, "an analogue-to-digital converter with fewer bits, or a nonlinear one"),
        **in_folders("simulators.effects", "EFFECTS"),
    }
)


def _fitting(name: str, effect: type[Any]) -> type[Any]:
    """The class of an effect of another package, which states its own domain, summary and place."""
    if effect.name != name:
        raise ValueError(f"the `name` of its class is {effect.name!r}; expected the name of the entry point")
    _entry_of(effect)
    return effect


def _entry_of(effect: type[Any]) -> EffectRow:
    summary, follows = (effect.__doc__ or "").partition("\n")[0], frozenset(getattr(effect, "follows", ()))
    return EffectRow(Domain(effect.domain), summary, follows, getattr(effect, "reason", "its package says so"))


_PLUGGED: Registry[type[Any]] = Registry("effect", {}, _fitting, reserved=_OURS)
_ALL = {**_OURS, **{name: _entry_of(effect) for name, effect in _PLUGGED.items()}}


def _place(name: str) -> tuple[Domain, bool, int]:
    """Position of an effect: first by its domain, and within the domain after all effects that it must follow."""

    def depth(name: str) -> int:
        return max((1 + depth(before) for before in _ALL[name].follows if before in _ALL), default=0)

    return _ALL[name].domain, name in FINAL, depth(name)


CATALOGUE: Mapping[str, EffectRow] = MappingProxyType({name: _ALL[name] for name in sorted(_ALL, key=_place)})


def order_error(earlier: str, later: str) -> str:
    """The reason why two effects of one domain cannot have this order; "" if they can."""
    entry = CATALOGUE.get(earlier)
    if entry is None or later not in entry.follows:
        return ""
    return f"effect {later!r} must come before {earlier!r}: {entry.reason}"


def load_effect(name: str) -> type[Any]:
    """The class (see chain.AnyEffect) of an effect; this imports its module."""
    if name in _PLUGGED:
        return _PLUGGED[name]
    return getattr(import_module(CATALOGUE[name].module), class_of(name))


def class_of(name: str) -> str:
    """PhotonNoise for photon_noise."""
    return name.title().replace("_", "")
