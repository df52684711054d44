"""Catalogue: every effect by name, without importing any: an effect's module is loaded when a scene names it.

The module of effect `photon_noise` is simulators.effects.photon_noise, and its class PhotonNoise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any

from simulators.frame.domain import Domain


@dataclass(frozen=True)
class Entry:
    domain: Domain
    says: str
    """What happens, in half a sentence."""


CATALOGUE: Mapping[str, Entry] = MappingProxyType(
    {
        "motion_blur": Entry(Domain.MOTION, "the sample turns during the exposure"),
        "rolling_shutter": Entry(Domain.MOTION, "lower rows are exposed later and see the sample turned further"),
        "afterglow": Entry(Domain.MOTION, "the scintillator still glows from before"),
        "encoder_error": Entry(Domain.MOTION, "the stage is not quite at the angle that its encoder reads"),
        "backlash": Entry(Domain.MOTION, "after the stage has turned backwards the sample lags behind"),
        "stage_wobble": Entry(Domain.MOTION, "the rotation axis tilts as the stage turns"),
        "runout": Entry(Domain.MOTION, "the rotation axis wanders as the stage turns"),
        "jump": Entry(Domain.MOTION, "the sample slips on the stage once"),
        "floaters": Entry(Domain.OPTICAL_DEPTH, "crumbs far from the axis come into view for a few views"),
        "phase_fringes": Entry(Domain.OPTICAL_DEPTH, "edges get bright rims on the way to the detector"),
        "harmonics": Entry(Domain.OPTICAL_DEPTH, "some photons have three times the energy"),
        "beam_hardening": Entry(Domain.OPTICAL_DEPTH, "the beam has several energies, and the softer ones go first"),
        "beam_profile": Entry(Domain.PHOTONS, "the beam is bright in the middle and striped, and wanders"),
        "ring_current": Entry(Domain.PHOTONS, "the ring current falls and is topped up"),
        "ghost": Entry(Domain.PHOTONS, "something like fog crosses the frame in a few views"),
        "black_band": Entry(Domain.PHOTONS, "a slit darkens a band at the left side"),
        "narrow_field": Entry(Domain.PHOTONS, "the beam is narrower than the sample"),
        "lost_beam": Entry(Domain.PHOTONS, "for a while there is no light, or less of it"),
        "scatter": Entry(Domain.PHOTONS, "photons that the sample deflects arrive elsewhere"),
        "scintillator_blur": Entry(Domain.PHOTONS, "scintillator and optics blur, and glare far away"),
        "flat_structure": Entry(Domain.PHOTONS, "dust and scratches on scintillator and optics"),
        "quantum_efficiency": Entry(Domain.PHOTONS, "the sensor detects a share of the photons"),
        "prnu": Entry(Domain.PHOTONS, "pixels differ in how much light they detect"),
        "photon_noise": Entry(Domain.PHOTONS, "photons arrive at random"),
        "dark_current": Entry(Domain.ELECTRONS, "electrons without light"),
        "hot_pixels": Entry(Domain.ELECTRONS, "a few pixels have a large dark current"),
        "zingers": Entry(Domain.ELECTRONS, "stray X-rays hit the sensor"),
        "saturation": Entry(Domain.ELECTRONS, "a pixel holds no more than its full well"),
        "dead_pixels": Entry(Domain.ELECTRONS, "a few pixels see no light"),
        "read_noise": Entry(Domain.ELECTRONS, "noise of the readout"),
        "offset": Entry(Domain.COUNTS, "the digital bias"),
        "adc": Entry(Domain.COUNTS, "a converter of fewer bits, or not quite straight"),
    }
)


def load_effect(name: str) -> type[Any]:
    """The class (see chain.AnyEffect) of an effect of the catalogue; only now is its module imported."""
    module = import_module(f"simulators.effects.{name}")
    return getattr(module, name.title().replace("_", ""))
