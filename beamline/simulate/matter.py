"""Matter: what the tables of cross sections say of a material that an option names."""

from __future__ import annotations

import math
import re

import numpy as np

from recon.prep.phase import HC
from simulators.light.beam import Beam, Tube
from simulators.light.materials import Material, Reals, of_formula
from simulators.light.palette import known, known_names
from simulators.light.spectrum import Spectrum, light

_TUBE = re.compile(r"(\d+(?:\.\d+)?)kV((?:,\w+=\d+(?:\.\d+)?)*)")
_DEEP = 10.0  # line integral up to which a tube's spectrum is refined


def delta_beta(name: str, energy_kev: float) -> float:
    """Ratio of delta to beta = mu wavelength / 4 pi of a material at an energy; its density does not matter.

    Args:
        name: that scenes know (see `simulators.light.palette`), or a chemical formula.

    Raises:
        ValueError: neither of them, or an energy outside the tables.
    """
    material = _material(name)
    beta = float(material.attenuation(energy_kev)) * HC / energy_kev / (4 * math.pi)
    return material.decrement(energy_kev) / beta


def in_beam(name: str, beam: str) -> tuple[Reals, Reals]:
    """Attenuation of a material at the energies of a beam, and their shares of the light detected.

    Args:
        name: as in `delta_beta`; of a formula in 1/mm at 1 g/cm3.
        beam: a tube such as "60kV", behind mm of filters "60kV,Al=1,Cu=0.1". Or a text file of two columns, keV and
            weight (without regard to its unit, the detector's response within it). A filter needs its density: it is
            one of the materials that scenes know.

    Raises:
        ValueError: what is wrong with either.
    """
    material, tube = _material(name), _TUBE.fullmatch(beam)
    if tube is not None:
        filters = dict(part.split("=") for part in tube[2].split(",")[1:])
        source = Beam(0.0, tube=Tube(float(tube[1]), {of: float(mm) for of, mm in filters.items()}))
        thickness = _DEEP / float(material.attenuation(float(tube[1]) / 2))
        found = light(source, [material.attenuation], thickness, lambda of: _filter(of).attenuation)
    else:
        try:
            table = np.loadtxt(beam, ndmin=2)
        except (OSError, ValueError) as error:
            raise ValueError(f"{beam} is neither a tube such as 60kV,Al=1 nor a table of keV and weight") from error
        if table.shape[1] != 2 or not (table >= 0).all() or not table[:, 1].any():
            raise ValueError(f"{beam} must hold two columns, keV and weight, 0 or more, and not all weights 0")
        found = Spectrum.of(table[:, 0], table[:, 1])
    return material.attenuation(found.energies), found.weights


def _filter(name: str) -> Material:
    found = known(name)
    if found is None:
        raise ValueError(f"the filter {name!r} has no known density; expected one of {', '.join(known_names())}")
    return found


def _material(name: str) -> Material:
    found = known(name)
    try:
        return of_formula(name, name, 1.0) if found is None else found
    except ValueError as error:
        raise ValueError(f"{name!r} is neither a material that scenes know nor a chemical formula") from error
