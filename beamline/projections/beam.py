"""Beam: a material's attenuation at the energies of a beam that an option names."""

from __future__ import annotations

import re

import numpy as np

from recon.base.arrays import F64
from recon.prep.matter import mass_attenuation, tube_spectrum

_TUBE = re.compile(r"(\d+(?:\.\d+)?)kV((?:,\w+=\d+(?:\.\d+)?)*)")


def in_beam(material: str, beam: str) -> tuple[F64, F64]:
    """Mass attenuation of a material at the energies of a beam, cm²/g, and their shares of the light detected.

    Args:
        material: a known one, or a chemical formula.
        beam: a tube such as "60kV", behind mm of filters "60kV,Al=1,Cu=0.1". Or a text file of two columns, keV and
            weight, with the detector's response and in any unit. A filter needs its density: it is
            one of the known materials.

    Raises:
        ValueError: what is wrong with either.
    """
    tube = _TUBE.fullmatch(beam)
    if tube is not None:
        filters = dict(part.split("=") for part in tube[2].split(",")[1:])
        energies, weights = tube_spectrum(float(tube[1]), {name: float(mm) for name, mm in filters.items()})
    else:
        try:
            table = np.loadtxt(beam, ndmin=2)
        except (OSError, ValueError) as error:
            raise ValueError(f"{beam} is neither a tube such as 60kV,Al=1 nor a table of keV and weight") from error
        if table.shape[1] != 2 or not (table >= 0).all() or not table[:, 1].any():
            raise ValueError(f"{beam} must hold two columns, keV and weight, 0 or more, and not all weights 0")
        energies, weights = table[table[:, 1] > 0].T
    return mass_attenuation(material, energies), weights
