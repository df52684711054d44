"""Particles of the scene `operando` in few projections: errors of the numbers, and how often intervals hold the truth.

python bench_states.py [--seeds 21 22] [--states 3 6 9] [--views 45] [--photons 1e4] [--rows 48] [--method fista-tv]
    [--set KEY=VALUE ...]

A row for each state: particles that are whole and have no new crack; bias and standard deviation of grey level and
volume in per cent; share of 80 % intervals that hold the truth; cracked particles that were found, and others that
were called cracked. The reference has 600 projections.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from state_scenes import PITCH, States

from recon import Grid
from recon.base.arrays import F32
from recon.features.reference.particle_states import (
    ReferenceParticles,
    StateNumbers,
    fit_state,
    numbers_of,
    reference_particles,
)
from splatline_structure.materials import materials_of
from splatline_structure.particles import NECK, cleaned, parted
from splatline_structure.volumes import box_in

_CRACK, _WIDE = 0.02, 0.325  # um, from which a particle is left out of the errors, and should be called cracked
_NEAR = 2.0  # voxels between a particle and its truth


@dataclass(frozen=True, eq=False)
class Errors:
    """Of particles of a state.

    Attributes:
        usual: whole and without a new crack.
        grey, volume: errors of relative changes, in per cent.
        held: [particle, (grey, volume, z, y, x)] whether the interval holds the truth.
        cracked, told: with a new crack of half a pixel or more, and called cracked; of whole particles.
    """

    usual: NDArray[np.bool_]
    grey: NDArray[np.float64]
    volume: NDArray[np.float64]
    held: NDArray[np.bool_]
    cracked: NDArray[np.bool_]
    told: NDArray[np.bool_]


def reference_of(states: States, volume: F32) -> ReferenceParticles:
    """The particles of a volume [z, y, x], as the command finds them."""
    thresholds = materials_of(np.ascontiguousarray(volume[box_in(volume, "square")]), 2).thresholds
    labels = parted(cleaned(volume > thresholds[0]), NECK)
    return reference_particles(volume, labels, Grid.matching(states.geometry(1)))


def errors_of(states: States, reference: ReferenceParticles, numbers: StateNumbers, state: float) -> Errors:
    """The numbers minus the truth of the scene."""
    before, after = states.truth(0), states.truth(state)
    middle = (np.array(reference.grid.shape) - 1) / 2
    places = np.stack([before[f"{axis}_mm"] for axis in "zyx"], axis=1) / PITCH + middle
    own = np.array([body.centre for body in reference.bodies])[:, [2, 0, 1]]
    apart = np.linalg.norm(own[:, None] - places, axis=2)
    which = apart.argmin(1)
    whole = (apart.min(1) < _NEAR) & ~reference.cut & np.isfinite(numbers.growth[:, 0])
    crack = after["crack_um"][which] > _CRACK
    level = np.array([body.level for body in reference.bodies])
    grey = 1 + level / (level + reference.around) * (after["grey"][which] - 1)
    growth = after["growth"][which]
    shift = np.stack([after[f"shift_{axis}_mm"][which] for axis in "zyx"], axis=1)
    held = [(low <= true) & (true <= high) for (_, low, high), true in (
        (numbers.grey_change.T, grey - 1), (numbers.growth.T, growth),
        *((numbers.shift[:, k].T, shift[:, k]) for k in range(3)),
    )]  # fmt: skip
    told = np.array([each == "cracked" for each in numbers.verdict])
    return Errors(
        whole & ~crack, 100 * (numbers.grey_change[:, 0] + 1 - grey), 100 * (numbers.growth[:, 0] - growth),
        np.stack(held, axis=1), whole & (after["crack_um"][which] >= _WIDE), whole & told,
    )  # fmt: skip


def row(name: str, found: list[Errors]) -> str:
    """The figures of some states together."""
    usual, grey, volume, held, cracked, told = (
        np.concatenate([getattr(each, part) for each in found])
        for part in ("usual", "grey", "volume", "held", "cracked", "told")
    )
    shares = " | ".join(f"{share:.2f}" for share in held[usual].mean(0))
    return (
        f"| {name} | {usual.sum()} | {grey[usual].mean():+.2f} | {grey[usual].std():.2f} | "
        f"{volume[usual].mean():+.2f} | {volume[usual].std():.2f} | {shares} | {(cracked & told).sum()} of "
        f"{cracked.sum()} | {(usual & told).sum()} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[21, 22])
    parser.add_argument("--states", nargs="+", type=float, default=[3, 6, 9])
    parser.add_argument("--views", type=int, default=45)
    parser.add_argument("--photons", type=float, default=1e4)
    parser.add_argument("--rows", type=int, default=48)
    parser.add_argument("--method", default="fista-tv")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    names = "seed, state", "particles", "grey bias", "sd", "volume bias", "sd", "held: grey", "volume", "z", "y", "x"
    print(f"| {' | '.join((*names, 'cracks found', 'wrongly'))} |")
    every = []
    for seed in given.seeds:
        states = States(seed, rows=given.rows, photons=given.photons, others=tuple(given.set))
        careful = States(seed, rows=given.rows, others=tuple(given.set))
        reference = reference_of(careful, careful.reference(600, given.method).data)
        for state in given.states:
            begin = time.process_time()
            fit = fit_state(reference, states.lines(state, given.views), states.geometry(given.views), None)
            every.append(errors_of(states, reference, numbers_of(reference, fit), state))
            print(row(f"{seed}, {state:g}", every[-1:]), f"{time.process_time() - begin:.0f} s", flush=True)
    print(row("all", every))


if __name__ == "__main__":
    main()
