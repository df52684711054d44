"""Parameters: for every effect of the catalogue, the least that it needs to show in a small frame (shots.shot()).

A new effect gets its line here; test_on_demand.py then proves that a scene without the effect takes no time for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

PARAMETERS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "motion_blur": {"max_samples": 3},
        "rolling_shutter": {},
        "encoder_error": {"harmonics": [[3, 300.0, 0.0]], "random_mdeg": 50.0},
        "backlash": {"lost_motion_deg": 1.0},
        "stage_wobble": {"harmonics": [[2, 5000.0, 0.0]], "random_urad": 1000.0},
        "runout": {"radial": [[2, 10.0, 0.0]], "radial_random_um": 3.0},
        "afterglow": {"shares": [0.2], "decay_times": [1.0]},
        "jump": {"view": 1, "shift_um": [30.0, 0.0, 10.0]},
        "pixel_area": {},
        "floaters": {"distance": [0.3, 0.3], "count": 2},
        "phase_fringes": {"delta_beta": 3.0, "distance": 5000.0, "energy": 20.0},
        "harmonics": {"share": 0.1},
        "beam_hardening": {"weights": [1.0, 1.0], "ratios": [1.0, 2.0]},
        "beam_profile": {"sigma": [1.0, 1.0]},
        "beam_bend": {"curvature": [0.1, 0.0]},
        "ring_current": {"lifetime": 100.0},
        "scatter": {"ratio": 0.1},
        "scintillator_blur": {"fwhm_um": 40.0},
        "flat_structure": {"specks": 1000, "radius_um": 500.0},
        "quantum_efficiency": {"value": 0.7},
        "prnu": {},
        "ghost": {"view": 0, "width": 0.2, "speed": 0.1},
        "black_band": {"width": 0.05},
        "narrow_field": {"width": 0.6},
        "lost_beam": {"views": [2, 3], "share": 0.5},
        "photon_noise": {},
        "dark_current": {},
        "hot_pixels": {"fraction": 1e-3},
        "zingers": {"rate": 10.0},
        "saturation": {"full_well": 3000.0},
        "dead_pixels": {"fraction": 1e-3},
        "read_noise": {},
        "offset": {},
        "adc": {"bits": 8},
    }
)


def entry(name: str) -> dict[str, Any]:
    """The effect in the form of a scene."""
    return {"kind": name, **PARAMETERS[name]}
