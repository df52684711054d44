"""An energy series: scans a sample at several energies, reconstructs it, and prints how much it absorbs at each.

python energy_series.py my.yaml 24.9 25.1 25.3
"""

import sys

import numpy as np

import recon
from beamline import api


def move_monochromator(energy_kev: float) -> None:
    """Move the monochromator through your control system, e.g. by `epics.caput(...)`; return when it has stopped."""


config, *energies = sys.argv[1:]
scans = []

with api.connect(config, set={"recon.live": False}) as instrument:
    for energy in map(float, energies):
        move_monochromator(energy)
        scans.append(instrument.scan(sample=f"cathode_{energy:g}keV", energy_kev=energy))

for energy, scan in zip(energies, scans, strict=True):
    # The same method for all energies, because "auto" may choose a different one for each.
    result = api.reconstruct(scan.path, recon.Fbp(), output=scan.folder / "fbp.h5")
    absorption = np.percentile(result.volume.data, 99)
    print(f"{energy} keV: {absorption:.3f} {result.units} in the most absorbing voxels, {result.output}")
