"""Pictures of particles in several states: curves, distributions, and the particles in a slice of the reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from beamline.report.figures import WIDTH, draw_slice, finish, new_figure, planes, png
from beamline.report.html import Picture
from splatline_structure.materials import F64

if TYPE_CHECKING:
    from recon.features.reference.particle_states import ReferenceParticles
    from splatline_structure.states import MeasuredState

_LINES = 60  # largest number of curves of single particles
_COLOURS = {"cracked": (1, 0.1, 0.1, 0.6), "closed": (0.1, 0.8, 0.1, 0.6), "gone": (0.2, 0.3, 1, 0.6)}
NAMES = {"grey": "change of the grey level (%)", "volume": "change of the volume (%)"}


def pictures_of(reference: ReferenceParticles, states: Sequence[MeasuredState], across: str) -> list[Picture]:
    """All pictures of a page."""
    whole, positions = ~reference.cut, np.array([state.at for state in states])
    series = {
        "grey": 100 * np.stack([state.numbers.grey_change[whole] for state in states], axis=1),
        "volume": 100 * np.stack([state.numbers.growth[whole] for state in states], axis=1),
    }
    verdicts = np.array([state.numbers.verdict for state in states])[:, whole]
    return [
        Picture(
            "Particles against the states",
            "Thin lines show single particles; one of these particles also has its interval. The thick line is the "
            "median, and the band spans 10 % to 90 % of the particles. The lower graph shows how many particles are "
            "cracked, closed or gone.",
            curves(series, verdicts, positions, across),
        ),
        Picture(
            "Distribution over the particles",
            "For each state, the share of the particles whose measured number is below the value on the axis.",
            distributions(series, [state.path.name for state in states]),
        ),
        Picture(
            "The last state", (
                "The middle slice of the reference. Cracked particles are red, particles whose crack closed are "
                "green, and particles that are gone are blue."
            ),
            map_of(reference, states[-1]),
        ),
    ]  # fmt: skip


def curves(series: dict[str, F64], verdicts: Any, positions: F64, across: str) -> bytes:
    """Numbers [particle, state, 3] with the median and the spread, and the number of particles of each verdict."""
    figure = new_figure((WIDTH, 7.5))
    *panels, below = np.ravel(figure.subplots(3, 1, sharex=True))
    for axes, (name, each) in zip(panels, series.items(), strict=True):
        value = each[..., 0]
        shown = np.flatnonzero(np.isfinite(value).any(1))
        drawn_lines = shown[np.linspace(0, max(shown.size - 1, 0), min(_LINES, shown.size)).astype(int)]
        axes.plot(positions, value[drawn_lines].T, ".-", color="0.7", linewidth=0.5, markersize=2)
        if shown.size:
            typical_particle = each[shown[shown.size // 2]]
            axes.errorbar(
                positions,
                typical_particle[:, 0],
                np.abs(typical_particle[:, 1:].T - typical_particle[:, 0]),
                color="C1",
                capsize=2,
                linewidth=1,
            )
        has_values = np.isfinite(value).any(0)
        if has_values.any():
            low, middle, high = np.nanpercentile(value[:, has_values], (10, 50, 90), axis=0)
            axes.fill_between(positions[has_values], low, high, alpha=0.3)
            axes.plot(positions[has_values], middle, "o-")
        finish(axes, "", NAMES[name], size=8, grid=True)
    for name in _COLOURS:
        below.plot(positions, (verdicts == name).sum(1), "o-", label=name)
    below.yaxis.get_major_locator().set_params(integer=True)
    finish(below, across, "particles", size=8, grid=True)
    return png(figure)


def distributions(series: dict[str, F64], names: Sequence[str]) -> bytes:
    """The share of particles below each value."""
    figure = new_figure((WIDTH, 3.2))
    for axes, (name, each) in zip(np.ravel(figure.subplots(1, 2, sharey=True)), series.items(), strict=True):
        for state, label in enumerate(names):
            value = np.sort(each[:, state, 0])
            value = value[np.isfinite(value)]
            axes.plot(value, (np.arange(value.size) + 0.5) / max(value.size, 1), label=label if name == "grey" else "")
        finish(axes, NAMES[name], "share of the particles", size=8, grid=True)
    return png(figure)


def map_of(reference: ReferenceParticles, state: MeasuredState) -> bytes:
    """The middle slice of the reference with its particles coloured by growth, and by verdict."""
    grid, growth = reference.grid, 100 * state.numbers.growth[:, 0]
    middle_slice = grid.shape[0] // 2
    volume, owner = reference.volume[:, :, middle_slice] / grid.voxel_size, reference.owner[:, :, middle_slice]
    inside = (
        volume
        > reference.around / grid.voxel_size + 0.5 * np.median([b.level for b in reference.bodies]) / grid.voxel_size
    )
    figure = new_figure((WIDTH, WIDTH / 2 * grid.shape[1] / grid.shape[2] + 0.6))
    volume_axes, right = np.ravel(figure.subplots(1, 2, sharex=True, sharey=True))
    plane = planes(grid, "mm")[0]
    shown = draw_slice(volume_axes, volume, plane, "verdict", (0.0, float(np.percentile(volume, 99.5)) or 1.0), size=7)
    colours = np.zeros((*volume.shape, 4))
    for name, colour in _COLOURS.items():
        numbers = 1 + np.flatnonzero(np.array(state.numbers.verdict) == name)
        colours[np.isin(owner, numbers) & inside] = colour
    volume_axes.imshow(colours, extent=shown.get_extent(), interpolation="nearest")
    of_owner = np.concatenate(([np.nan], growth))[owner]
    window = tuple(np.nanpercentile(growth, (2, 98))) if np.isfinite(growth).any() else (0.0, 1.0)
    drawn = draw_slice(right, np.where(inside, of_owner, np.nan), plane, NAMES["volume"], window, "viridis", 7)
    figure.colorbar(drawn, ax=right, shrink=0.7)
    right.label_outer()
    return png(figure)
