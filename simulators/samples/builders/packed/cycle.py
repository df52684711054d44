"""Cycle: the states of a battery electrode during a charge and a discharge, for a series of scans.

The values are those of LiCoO2 agglomerates: growth of 4 % with a spread of 0.5 % (Nat. Nanotechnol. 2023,
s41565-023-01466-4). Mass is conserved, so the attenuation falls when the volume grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from recon.base.setting import Setting, setting
from simulators.frame.mapping import NotNegative, Share, Whole
from simulators.samples.bodies.solids import Cylinder, Ellipsoid, Polyhedron, Quaternion, Vector, corners
from simulators.samples.builders.packed.cathode import CRACK, inner_radius

if TYPE_CHECKING:
    from simulators.samples.builders.packed.pieces import Piece
    from simulators.samples.sample import TruthTable

LATEST = 0.9  # highest charge at which a crack begins to open
_TRIED = 2000  # number of points at which space for the bubble is searched


@dataclass(frozen=True)
class Cycle:
    """Particles that grow, crack and move while a battery charges and discharges.

    State 0 is the reference. The charge rises from 0 to 1 in the first half of the states, and falls to 0 in the second
    half.

    Attributes:
        state: number of the state at the beginning; a fraction lies between two states.
        states: number of the last state.
        every_s: s from one state to the next; None: the state does not change during a scan.
        growth, spread: mean and standard deviation of the relative change of a particle's volume at charge 1. The
            contrast of a particle to its surroundings is multiplied by 1/(1 + growth).
        inactive: share of particles that do not grow.
        swelling: relative change, at charge 1, of the heights above the lowest particle.
        walk_um, walk_deg: standard deviations of the motion of the whole sample from one state to the next: shift along
            each axis, and rotation about the rotation axis.
        cracked: share of particles that crack. A crack begins to open at a charge between 0.5 and 0.9.
        crack_um: least and largest width of cracks at charge 1.
        healing: share of these cracks that close again while the charge falls.
        bubble_um: largest diameter of a gas bubble, which exists from state 1 on; 0: no bubble.
        seed: of all random numbers.
    """

    state: NotNegative = 0.0
    states: int = setting(12, ge=2, le=10_000)
    every_s: Annotated[float, Setting(gt=0, le=1e6)] | None = None
    growth: float = setting(0.04, gt=-0.5, le=1)
    spread: float = setting(0.005, ge=0, le=0.1)
    inactive: Share = 0.1
    swelling: float = setting(0.03, gt=-0.5, le=1)
    walk_um: NotNegative = 0.65
    walk_deg: float = setting(0.05, ge=0, le=10)
    cracked: Share = 0.2
    crack_um: tuple[NotNegative, NotNegative] = (0.3, 1.3)
    healing: Share = 0.5
    bubble_um: NotNegative = 10.0
    seed: Whole = 0

    def __post_init__(self) -> None:
        if self.state > self.states:
            raise ValueError(f"state must be at most {self.states}, the number of states, got {self.state:g}")
        if self.crack_um[0] > self.crack_um[1]:
            raise ValueError(f"crack_um are the least and the largest width, got {self.crack_um}")

    def moment(self, seconds: float) -> float:
        """The state at `seconds` s after the camera was connected."""
        passed = 0 if self.every_s is None else math.floor(max(seconds, 0.0) / self.every_s)
        return float(min(self.state + passed, self.states))

    def table(self, pieces: Sequence[Piece]) -> TruthTable:
        """The true values of each particle at the beginning, by its number from 1."""
        drawn = _Drawn.of(self, sum(piece.role == "particle" for piece in pieces))
        charge, growth, width = drawn.at(self, self.state)
        moved = [piece.solid.centre for piece in self.at(pieces, self.state) if piece.role == "particle"]
        before = [piece.solid.centre for piece in pieces if piece.role == "particle"]
        x, y, z = np.array(moved).reshape(-1, 3).T
        shift = (np.array(moved) - np.array(before)).reshape(-1, 3).T
        return {
            "particle": np.arange(1, growth.size + 1), "z_mm": z, "y_mm": y, "x_mm": x, "shift_z_mm": shift[2],
            "shift_y_mm": shift[1], "shift_x_mm": shift[0], "growth": growth, "grey": 1 / (1 + growth),
            "crack_um": width, "charge": np.full(growth.size, charge),
        }  # fmt: skip

    def at(self, pieces: Sequence[Piece], moment: float) -> tuple[Piece, ...]:
        """The pieces in a state."""
        own = [piece.solid for piece in pieces if piece.role == "particle"]
        if not own:
            raise ValueError("the sample has no part 'particle', so there is nothing that could charge")
        drawn = _Drawn.of(self, len(own))
        charge, growth, width = drawn.at(self, moment)
        bottom = min(solid.centre[2] for solid in own)
        grown: list[Piece] = []
        number = -1
        for piece in pieces:
            number += piece.role == "particle"
            if piece.role not in ("particle", "pore", "crack"):
                grown.append(piece)
                continue
            scaled = _scaled(piece, float(np.cbrt(1 + growth[number])), 1 / (1 + float(growth[number])))
            x, y, z = scaled.solid.centre
            scaled = _placed(scaled, (x, y, bottom + (1 + self.swelling * charge) * (z - bottom)))
            grown.append(scaled)
            if piece.role == "particle" and width[number] > 0:
                solid = scaled.solid
                assert isinstance(solid, Ellipsoid | Polyhedron)
                wide = CRACK[0] * inner_radius(solid)
                thin = min(width[number] * 0.5e-3, wide)
                crack = Ellipsoid((wide, wide, thin), solid.attenuation, solid.centre, drawn.turns[number])
                grown.append(replace(piece, solid=crack, role="crack", instead_of="particle"))
        if moment >= 1 and self.bubble_um:
            grown += self._bubble(pieces, grown)
        shift, turn = drawn.walk[: math.floor(moment)].sum(axis=0)[:3], drawn.walk[: math.floor(moment), 3].sum()
        return tuple(_moved(piece, shift, float(turn)) for piece in grown)

    def _bubble(self, pieces: Sequence[Piece], grown: Sequence[Piece]) -> list[Piece]:
        """The bubble. It is at the place in the electrolyte with the most space, among many places, and is the same in
        all states.
        """
        own = [piece.solid for piece in pieces if piece.role == "particle"]
        centres = np.array([solid.centre for solid in own])
        reach = np.array([_reach(solid) for solid in own])
        room = np.abs(centres).max(axis=0) * (0.7, 0.7, 0.5)
        points = np.random.default_rng([self.seed, 1]).uniform(-1, 1, (_TRIED, 3)) * room
        clear = np.array([(np.linalg.norm(centres - point, axis=1) - reach).min() for point in points])
        best = int(clear.argmax())
        radius = min(self.bubble_um * 0.5e-3, float(clear[best]))
        if radius <= 0:
            return []
        x, y, z = points[best].tolist()
        body = Ellipsoid((radius,) * 3, 1.0, (x, y, z))
        return [replace(grown[0], solid=body, role="gas", instead_of="electrolyte")]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """The random numbers of a cycle, for each particle.

    Attributes:
        growth: relative change of the volume at charge 1.
        opens: charge at which its crack begins to open.
        width: width of its crack at charge 1 in um; 0: the particle does not crack.
        heals: True if its crack closes while the charge falls.
        turns: orientation of its crack.
        walk: [state, 4] shift (x, y, z) in mm, and rotation in radians, from each state to the next.
    """

    growth: NDArray[np.float64]
    opens: NDArray[np.float64]
    width: NDArray[np.float64]
    heals: NDArray[np.bool_]
    turns: list[Quaternion]
    walk: NDArray[np.float64]

    @classmethod
    def of(cls, cycle: Cycle, n: int) -> _Drawn:
        rng = np.random.default_rng(cycle.seed)
        growth = np.where(rng.uniform(size=n) < cycle.inactive, 0.0, rng.normal(cycle.growth, cycle.spread, n))
        cracks, opens = rng.uniform(size=n) < cycle.cracked, rng.uniform(0.5, LATEST, n)
        width, heals = cracks * rng.uniform(*cycle.crack_um, n), rng.uniform(size=n) < cycle.healing
        turns = [(w, x, y, z) for w, x, y, z in rng.normal(size=(n, 4)).tolist()]
        sizes = (*[cycle.walk_um * 1e-3] * 3, math.radians(cycle.walk_deg))
        return cls(growth, opens, width, heals, turns, rng.normal(size=(cycle.states, 4)) * sizes)

    def at(self, cycle: Cycle, state: float) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """The charge in a state, and for each particle its growth and the width of its new crack in um."""
        charge = 1 - abs(2 * state / cycle.states - 1)
        share = np.clip((charge - self.opens) / (1 - self.opens), 0, 1)
        if 2 * state > cycle.states:
            share = np.where(self.heals, share, 1.0)
        return charge, charge * self.growth, share * self.width


def _reach(solid: object) -> float:
    """Radius in mm of the sphere around a particle."""
    if isinstance(solid, Ellipsoid):
        return max(solid.semi_axes)
    assert isinstance(solid, Polyhedron)
    return float(np.linalg.norm(solid.vertices, axis=1).max())


def _scaled(piece: Piece, by: float, share: float) -> Piece:
    """A particle, or a hole in a particle, that is `by` times as wide, with its attenuation multiplied by `share`."""
    solid = piece.solid
    if isinstance(solid, Ellipsoid):
        a, b, c = solid.semi_axes
        grown = replace(solid, semi_axes=(by * a, by * b, by * c), attenuation=share * solid.attenuation)
        return replace(piece, solid=grown)
    if not isinstance(solid, Polyhedron):
        raise ValueError(f"a {type(solid).__name__.lower()} cannot grow, only ellipsoids and polyhedra can")
    points = corners(by * np.array(solid.vertices))
    return replace(piece, solid=replace(solid, vertices=points, attenuation=share * solid.attenuation))


def _placed(piece: Piece, centre: Vector) -> Piece:
    return replace(piece, solid=replace(piece.solid, centre=centre))


def _moved(piece: Piece, shift: NDArray[np.float64], turn: float) -> Piece:
    """A piece after a rotation about the rotation axis and a shift."""
    solid, cos, sin = piece.solid, math.cos(turn), math.sin(turn)
    x, y, z = solid.centre
    dx, dy, dz = shift.tolist()
    centre = (cos * x - sin * y + dx, sin * x + cos * y + dy, z + dz)
    if isinstance(solid, Cylinder):
        return _placed(piece, centre)
    w, i, j, k = solid.quaternion
    c, s = math.cos(turn / 2), math.sin(turn / 2)
    turned = (c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w)
    return replace(piece, solid=replace(solid, centre=centre, quaternion=turned))
