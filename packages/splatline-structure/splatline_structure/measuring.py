"""What `beamline structure` measures in one volume."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.cli.terminal import Answer
from beamline.core.errors import ConfigError
from beamline.core.sinks import Note
from beamline.storage.volumes.files import opened_volume
from splatline_structure import intervals, volumes
from splatline_structure.intervals import measured_structure
from splatline_structure.materials import label_values
from splatline_structure.numbers import Rules
from splatline_structure.options import FEWEST_VIEWS


@dataclass(frozen=True, eq=False)
class Seen:
    """A volume that was read, and what was measured in it.

    Attributes:
        grid, volume: the grid and the voxels of the box.
    """

    path: Path
    read: volumes.ReadSlices
    box: volumes.Box
    grid: Any
    volume: Any
    found: intervals.MeasuredStructure

    def voxels(self, slices: slice) -> str:
        """The box in these slices of the volume, as text for the tables."""
        return ",".join(f"{each.start}:{each.stop}" for each in (slices, *self.box[1:]))


def seen_in(path: Path, read: volumes.ReadSlices, answer: Answer, **values: Any) -> Seen:
    """Measure one volume: the slices that fit into the memory, and fractions and surface in all slices."""
    if read.limit_sentence:
        answer.warn(f"{path}: {read.limit_sentence}")
    box = volumes.box_in(read.record.volume.data, values["crop"])
    measured_part = measured(path, read, box, answer, **values)
    if not read.limit_sentence:
        return measured_part
    slabs = volumes.slabs_of(path, values["dataset"], read, measured_part.box, answer.counting("reading slabs"))
    return replace(measured_part, found=intervals.with_all_slices(measured_part.found, slabs))


def measured(path: Path, read: volumes.ReadSlices, box: volumes.Box, answer: Answer, **values: Any) -> Seen:
    """Measure the slices of a volume that were read.

    Args:
        box: the part to measure, also in the volumes from halves of the projections.

    Raises:
        ConfigError: there is no such material. ValueError: no contrast, or the halves have other shapes.
    """
    grid, data, parts = read.record.grid.part(*box), read.record.volume.data, []
    volume = np.ascontiguousarray(data[box])
    labels = label_values(volume)
    n_materials = values["materials"] or labels.size or 2
    particles = values["particles"] or n_materials
    if labels.size not in (0, n_materials):
        raise ValueError(
            f"leave out --materials {n_materials}: the volume contains only {labels.size} different values "
            f"({', '.join(f'{each:g}' for each in labels)}), so they are labels and not grey values. Each label is a "
            "material"
        )
    if labels.size:
        materials = (f"{each:g} is material {number}" for number, each in enumerate(labels, 1))
        answer.warn(
            Note(
                f"{path} contains only a few different values. These values are read as labels and not as grey values: "
                f"{', '.join(materials)}."
            )
        )
    if max(particles, values["through"]) > n_materials:
        raise ConfigError(
            f"There is no material {max(particles, values['through'])}: the {n_materials} materials are numbered from "
            "1. Nothing was written."
        )
    for half in halves_in(path, read, answer, **values):
        if half.shape != data.shape:
            raise ValueError(
                f"the volume from half of the projections has the shape {half.shape}, not {data.shape}: give --parts "
                "with volumes of the same shape as the volume itself, or --quick"
            )
        parts.append(np.ascontiguousarray(half[box]))
    rules = Rules(particles, values["through"], values["radius"], values["smallest"], values["neck"], values["side"])
    dz, dy, dx = (1e3 * edge for edge in grid.spacing)
    try:
        structure = measured_structure(
            volume, parts, n_materials, (dz, dy, dx), rules, answer.counting("measuring the structure")
        )
    except ValueError as error:
        way_out = (
            f"only slices {read.slices.start}:{read.slices.stop} fit into the memory and were measured: give more "
            "--memory, or choose other --slices"
            if read.limit_sentence
            else "reconstruct from more projections"
        )
        raise ValueError(f"{error}; {way_out}{', or give fewer --materials' if n_materials > 2 else ''}") from error
    return Seen(path, read, box, grid, volume, structure)


def halves_in(path: Path, read: volumes.ReadSlices, answer: Answer, **values: Any) -> list[Any]:
    """The slices of the volume from each half of its projections; empty if not asked for, or if there is no scan."""
    if values["quick"]:
        return []
    if values["parts"]:
        halves = []
        for half in values["parts"]:
            with opened_volume(half) as opened:
                holds_all = opened.grid.shape[0] == read.n_slices  # otherwise it holds only these slices
                halves.append(opened.volume.data[read.slices if holds_all else slice(None)])
        return halves
    scan = values["scan"] or Path(read.record.raw_file)
    if not scan.is_file():
        answer.warn(
            f"The intervals of {path} leave out the error from few projections, because the scan of the volume "
            f"({scan}) does not exist. Give --scan or --parts."
        )
        return []
    if (n_views := int(read.record.parameters.get("n_views", FEWEST_VIEWS))) < FEWEST_VIEWS:
        raise ValueError(f"{n_views} projections are too few to divide them into halves: give --quick")
    return volumes.parts_of(read, scan, 2, answer.warn, answer.counting("reconstructing halves of the projections"))
