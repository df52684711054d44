"""Effects of scintillator, optics and sensor."""

from functools import partial

from simulators.effects import Domain, EffectRow

_optics, _pixels = (partial(EffectRow, module=f"{__name__}.{name}") for name in ("optics", "pixels"))
EFFECTS = {
    "rolling_shutter": _pixels(
        Domain.MOTION, "lower rows are exposed later, when the sample has rotated further (rolling shutter)"
    ),
    "afterglow": _optics(Domain.MOTION, "the scintillator still emits light of earlier exposures (afterglow)"),
    "scintillator_blur": _optics(
        Domain.PHOTONS,
        "scintillator and optics blur the image, and scatter light over long distances",
        frozenset({"beam_profile", "beam_bend", "narrow_field", "black_band"}),
        "the scintillator blurs all light that reaches it",
    ),
    "flat_structure": _optics(Domain.PHOTONS, "dust and scratches on scintillator and optics"),
    "prnu": _pixels(
        Domain.PHOTONS,
        "pixels differ in sensitivity",
        frozenset({"scatter", "scintillator_blur"}),
        "pixels differ in sensitivity to light that is already blurred",
    ),
    "hot_pixels": _pixels(Domain.ELECTRONS, "a few pixels have a large dark current"),
    "zingers": _pixels(Domain.ELECTRONS, "stray X-rays hit the sensor"),
    "dead_pixels": _pixels(
        Domain.ELECTRONS,
        "a few pixels do not respond to light (dead pixels)",
        frozenset({"dark_current", "hot_pixels", "zingers"}),
        "dead pixels hold a constant charge",
    ),
}
