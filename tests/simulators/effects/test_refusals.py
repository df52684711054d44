"""Wrong parameters of effects: a scene that has one is refused, with the path, the rule and the value."""

from __future__ import annotations

from typing import Any

import pytest

from simulators.effects.catalogue import load_effect
from simulators.frame.mapping import SceneError, build

NAN, INF = float("nan"), float("inf")
ALWAYS: dict[str, dict[str, Any]] = {
    "floaters": {"distance": [0.7, 0.9]},
    "ghost": {"view": 4, "width": 0.2, "speed": 0.3},
    "phase_fringes": {"delta_beta": 100.0, "distance": 50.0, "energy": 20.0},
}
"""What an effect cannot do without."""
NEEDED = ALWAYS | {
    "afterglow": {"decay_times": [1.0, 2.0], "shares": [0.1]},
    "beam_hardening": {"weights": [1.0], "ratios": [1.0, 2.0]},
    "beam_profile": {"sigma": [1.0, 1.0]},
    "black_band": {"width": 0.1},
    "harmonics": {"share": 0.1},
    "jump": {"turn_deg": 1.0},
    "lost_beam": {"views": [0, 1]},
    "narrow_field": {"width": 0.1},
    "ring_current": {"lifetime": 9.0, "top_up_below": 0.9},
    "scatter": {"ratio": 0.1},
    "scintillator_blur": {"fwhm_um": 5.0},
    "zingers": {"rate": 1.0},
}
"""So also for a value of one parameter."""
BEYOND: dict[str, dict[str, list[Any]]] = {
    "adc": {"nonlinearity": [1.0]},
    "afterglow": {"shares": [[-0.1, 0.4]], "decay_times": [[0.0]]},
    "backlash": {"lost_motion_deg": [0.0, NAN]},
    "beam_bend": {"level": [INF]},
    "beam_hardening": {"energies": [[0.0]], "weights": [[-1.0, 2.0]]},
    "beam_profile": {"sigma": [[1.0, 0.0]], "stripes": [1.0], "wander_period": [0.0]},
    "black_band": {"width": [0.0], "penumbra": [-1.0], "share": [1.0]},
    "dark_current": {"rate": [-1.0]},
    "dead_pixels": {"fraction": [2.0], "charge": [-1.0], "seed": [-1]},
    "encoder_error": {"harmonics": [[[1, -8.0, 0.0]]], "random_mdeg": [-3.0]},
    "flat_structure": {"specks": [-1], "scratches": [1001], "radius_um": [0.0], "depth": [0.6], "scratch_depth": [0.6]},
    "floaters": {
        "distance": [[0.0, 1.0], [0.7, 1e308]],
        "size": [[1e-308, 0.1]],
        "count": [0, 1000000000000000000000000000000],
        "heights": [[-1e308, 0.0]],
        "depth": [1e308, 0.0],
        "seed": [-1],
    },
    "ghost": {"view": [-1], "width": [0.0], "speed": [-0.1], "gain": [-1.5]},
    "harmonics": {"share": [-0.1, 1.1], "ratio": [1.5]},
    "hot_pixels": {"fraction": [2.0], "rate": [10000000000.0], "seed": [-1]},
    "jump": {"view": [-1]},
    "lost_beam": {"share": [1.0]},
    "motion_blur": {"tolerance_px": [0.0], "max_samples": [1]},
    "narrow_field": {"width": [0.0], "height": [0.0], "penumbra": [-1.0]},
    "offset": {"spread": [-1.0]},
    "phase_fringes": {"delta_beta": [-1.0], "energy": [0.0], "oversampling": [9]},
    "pixel_area": {"rays": [1, 9]},
    "prnu": {"spread": [0.5], "seed": [-1]},
    "quantum_efficiency": {"value": [1.2], "wavelength_nm": [0.55]},
    "read_noise": {"rms": [-1.0], "spread": [3.0], "seed": [-1]},
    "ring_current": {"lifetime": [0.0], "top_up_below": [1.0], "refill": [-1.0]},
    "runout": {"radial": [[[2, -5.0, 0.0]]], "axial_random_um": [-1.0]},
    "saturation": {"full_well": [0.0], "knee": [-0.1, 1.1]},
    "scatter": {"ratio": [-0.1], "background": [-1.0], "width_mm": [0.0]},
    "scintillator_blur": {"fwhm_um": [-1.0], "tail_share": [1.0], "tail_um": [0.0]},
    "stage_wobble": {"harmonics": [[[2, -5.0, 0.0]]], "random_urad": [-1.0]},
    "zingers": {"rate": [-2.0], "charge": [0.0], "tracks": [2.0], "length": [0.0], "radius": [-1.0]},
}
"""Effect -> parameter -> values beyond its bounds."""


@pytest.mark.parametrize("effect", BEYOND)
def test_a_value_beyond_its_bounds_is_refused_by_its_path(effect: str) -> None:
    for name, values in BEYOND[effect].items():
        for value in values:
            with pytest.raises(SceneError, match=rf"^{effect}\.{name}(\.\d)* is .+; expected a (whole )?number"):
                build(load_effect(effect), effect, NEEDED.get(effect, {}) | {name: value})


@pytest.mark.parametrize(
    ("effect", "wrong", "words"),
    [
        ("adc", {"bits": 10}, r"bits is 10; expected 8 \| 12 \| 16"),
        ("afterglow", {"shares": [], "decay_times": []}, "each component needs a share and a decay time"),
        ("afterglow", {"shares": [0.1], "decay_times": [1.0, 2.0]}, "each component needs a share and a decay time"),
        ("afterglow", {"shares": [0.6, 0.4], "decay_times": [1.0, 2.0]}, "sum of the shares must lie in 0"),
        (
            "afterglow",
            {"shares": [0.1], "decay_times": [1.0], "samples": 0},
            "samples is 0; expected a whole number",
        ),
        ("beam_hardening", {"weights": [1.0]}, "give either energies in keV or ratios"),
        ("beam_hardening", {"weights": [1.0], "energies": [20.0], "ratios": [1.0]}, "give either energies in keV or"),
        ("beam_hardening", {"weights": [1.0, 2.0], "energies": [20.0]}, "one weight for each energy"),
        ("beam_hardening", {"weights": [], "energies": []}, "one weight for each energy"),
        ("beam_hardening", {"weights": [0.0], "ratios": [1.0]}, "one of the weights must be positive"),
        ("black_band", {"width": 0.1, "views": [5, 5]}, r"views must be \[first, one after the last\] with 0 <= first"),
        ("black_band", {"width": 0.1, "views": [-1, 3]}, r"views must be \[first, one after the last\]"),
        ("floaters", {"size": [0.2, 0.1]}, r"size must be \[least, most\] in mm"),
        ("floaters", {"heights": [0.2, -0.2]}, r"heights must be \[least, most\] in mm"),
        ("floaters", {"views": [2, 2]}, "views must be"),
        ("floaters", {"motion": "loose"}, "loose floaters need views"),
        ("ghost", {"gain": 0.0}, "gain must be other than 0"),
        ("jump", {"view": 3}, "shift_um or turn_deg must be other than 0"),
        ("lost_beam", {}, "either views or seconds, and not both"),
        ("lost_beam", {"views": [0, 1], "seconds": [0.0, 1.0]}, "either views or seconds, and not both"),
        ("lost_beam", {"views": [3, 1]}, "views must be"),
        ("lost_beam", {"seconds": [1.0, 1.0]}, r"seconds must be \[from, to\] with from < to, got \[1.0, 1.0\]"),
        ("phase_fringes", {"method": "ray"}, r"method is 'ray'; expected wave \| transport"),
        ("phase_fringes", {"method": "transport", "oversampling": 2}, "oversampling is for the method wave"),
        ("quantum_efficiency", {}, "give one of value, wavelength_nm"),
        ("quantum_efficiency", {"value": 0.5, "wavelength_nm": 500.0}, "give one of value, wavelength_nm"),
        ("ring_current", {"lifetime": 9.0, "top_up_every": 5.0, "top_up_below": 0.9}, "exclude each other"),
        ("ring_current", {"lifetime": 9.0, "refill": 1.0}, "0 s without top_up_every or top_up_below, got 1.0 s"),
        ("ring_current", {"lifetime": 9.0, "top_up_every": 2.0, "refill": 2.0}, "longer than refill, got 2.0 and 2.0"),
        ("runout", {"axial": [[2, 5.0, 0.0], [2, 5.0, 0.0]]}, "axial must be"),
        (
            "scintillator_blur",
            {"fwhm_um": 5.0, "tail": "gaussian"},
            r"tail is 'gaussian'; expected exponential",
        ),
    ],
)
def test_a_wrong_parameter_is_refused(effect: str, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=rf"^{effect}(\.|: ).*{words}"):
        build(load_effect(effect), effect, ALWAYS.get(effect, {}) | wrong)
