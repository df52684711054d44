"""What a beam does that is not steady, even, wide enough and of one energy."""

from functools import partial

from simulators.effects import Domain, EffectRow

_energies, _open_beam = (partial(EffectRow, module=f"{__name__}.{name}") for name in ("energies", "open_beam"))
EFFECTS = {
    "harmonics": _energies(Domain.OPTICAL_DEPTH, "some photons have three times the energy"),
    "beam_hardening": _energies(Domain.OPTICAL_DEPTH, "soft energies of the beam are absorbed before hard ones"),
    "beam_bend": _open_beam(Domain.PHOTONS, "the open beam of the views is not that of the flats"),
    "ring_current": _open_beam(Domain.PHOTONS, "the ring current decays and is topped up"),
    "ghost": _open_beam(Domain.PHOTONS, "a fog-like change of the light crosses the frame in a few views"),
    "black_band": _open_beam(Domain.PHOTONS, "a slit darkens a band at the left side"),
    "narrow_field": _open_beam(Domain.PHOTONS, "the beam is narrower than the sample"),
    "lost_beam": _open_beam(Domain.PHOTONS, "for a time there is no light, or less of it"),
}
