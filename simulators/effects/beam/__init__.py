"""Effects of the beam: not constant, not uniform, too narrow, or of several energies."""

from functools import partial

from simulators.effects import Domain, EffectRow

_energies, _open_beam = (partial(EffectRow, module=f"{__name__}.{name}") for name in ("energies", "open_beam"))
EFFECTS = {
    "harmonics": _energies(
        Domain.OPTICAL_DEPTH, "some photons have three times the energy (third harmonic of the monochromator)"
    ),
    "beam_hardening": _energies(
        Domain.OPTICAL_DEPTH, "beam hardening: the sample absorbs low energies before high ones"
    ),
    "beam_bend": _open_beam(Domain.PHOTONS, "the open beam changes between flats and projections"),
    "ring_current": _open_beam(Domain.PHOTONS, "the ring current decays, and top-ups raise it again"),
    "ghost": _open_beam(
        Domain.PHOTONS, "a smooth change of the intensity moves across the frame within a few projections"
    ),
    "black_band": _open_beam(Domain.PHOTONS, "a slit darkens a band at the left side"),
    "narrow_field": _open_beam(Domain.PHOTONS, "the beam is narrower than the sample"),
    "lost_beam": _open_beam(Domain.PHOTONS, "for some time the beam is lost or weaker"),
}
