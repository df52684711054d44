"""Reads scene files, from the package or from the user, and computes the ground truth of their samples: attenuation and
labels on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from beamline.config.tree import override, read
from beamline.core.errors import ConfigError
from beamline.core.files import SETTINGS, atomic_file, text_in
from beamline.core.installed import shipped_scenes
from beamline.core.quantities import VoxelKind
from beamline.simulate import volumes_beside
from beamline.storage import hdf5
from beamline.storage.writers.recon_file import new_plot
from recon.base.geometry import Geometry
from recon.base.registry import unknown
from recon.base.volume import Grid
from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector
from simulators.samples.sample import Changing, Sample, TruthTable
from simulators.scenes.scene import Scene, load_scene


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene and its file. `text` is the content of the file with the overridden values; it is stored with the
    results.
    """

    scene: Scene
    path: Path
    text: str


def open_scene(name: str, overrides: Sequence[str] = ()) -> SceneFile:
    """The scene in a file, or the scene with this name in the package. `overrides` (KEY=VALUE) replace values.

    Raises:
        ConfigError: the scene does not exist, or it is wrong.
        DataError: a volume of the scene cannot be read.
    """
    path, tree, text = _scene_text(name, overrides)
    with _naming(path):
        return SceneFile(load_scene(tree, volumes_beside(path.parent)), path, text)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """A context whose errors about a scene name its file."""
    try:
        yield
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None


def _scene_text(name: str, overrides: Sequence[str]) -> tuple[Path, Mapping[str, Any], str]:
    """The file of a scene, its values and its text."""
    shipped = shipped_scenes()
    path = Path(name)
    if not path.is_file():
        if name not in shipped:
            raise ConfigError(
                f"The file {name} does not exist, and {unknown('scene', name, shipped)}. Nothing was simulated."
            )
        path = shipped[name]
    try:
        text = text_in(path, SETTINGS)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror or error}). Nothing was simulated.") from error
    tree = override(read(text, str(path)), overrides, environment={})
    return path, tree.data, yaml.safe_dump(tree.data, sort_keys=False) if overrides else text


LARGEST = 256  # Default number of voxels across: 256³ voxels with labels take 84 MB
BYTES_A_VOXEL = 16  # Measured peak memory in bytes per voxel: 12 for solids (float64 and float32), 16 for volumes


@dataclass(frozen=True, eq=False)
class Truth:
    """True voxels and labels of a sample.

    Attributes:
        values: float32 [z, y, x]; lengths are in mm.
        labels: uint8 [z, y, x]; 0 is air, k is the k-th name in `names`.
        table: a row for each particle. Positions are relative to the rotation axis and the middle of the sample.
    """

    grid: Grid
    values: NDArray[np.float32]
    labels: NDArray[np.uint8]
    names: tuple[str, ...]
    kind: VoxelKind = VoxelKind.ATTENUATION
    table: TruthTable = field(default_factory=dict)


def geometry_of(detector: Detector, angles: NDArray[np.float64]) -> Geometry:
    """The simulated rays as the geometry of a reconstruction. For a cone beam, the detector is assumed to be at the
    sample.
    """
    if np.isfinite(detector.sod):
        at, row = detector.sod, detector.axis_row
        return Geometry.cone(angles, detector.shape, detector.pitch, at, at, axis_col=detector.axis_col, axis_row=row)
    return Geometry.parallel(
        angles, detector.shape, pixel_pitch=detector.pitch, axis_col=detector.axis_col, axis_row=detector.axis_row
    )


def binning_of(detector: Detector) -> int:
    """The smallest binning with which a volume has at most LARGEST voxels across. It is limited by the number of rows
    and columns of a frame.
    """
    return max(1, min(-(-max(detector.shape) // LARGEST), *detector.shape))


def memory_of(detector: Detector, binning: int) -> int:
    """Peak memory of `truth_of` in bytes. Raises ValueError if the binning does not fit the frame."""
    return BYTES_A_VOXEL * math.prod(grid_of(detector, binning).shape)


def truth_of(sample: Sample, detector: Detector, binning: int) -> Truth:
    """The ground truth in voxels of `binning` pixels. Raises ValueError if the binning does not fit the frame."""
    grid = grid_of(detector, binning)
    z, y, x = grid.centre
    shifted = replace(grid, centre=(z + _above(detector, binning), y, x))
    table = sample.table if isinstance(sample, Changing) else {}
    return Truth(grid, sample.attenuation(shifted), sample.labels(shifted), sample.names, table=table)


def grid_of(detector: Detector, binning: int) -> Grid:
    """The grid of a reconstruction in voxels of `binning` pixels."""
    return Grid.matching(geometry_of(detector, np.zeros(1)).binned(binning))


def _above(detector: Detector, binning: int) -> float:
    """z in mm, in the scene, of the origin of a reconstruction. In a parallel beam this is the middle of the rows that
    form whole bins, see Geometry.binned.
    """
    if np.isfinite(detector.sod):
        return 0.0
    rows = detector.shape[0] // binning * binning
    return ((rows - 1) / 2 - detector.axis_row) * detector.pitch


def write_truth(path: Path, truth: Truth) -> None:
    """Write an HDF5 file with entry/data/data (read by `beamline recon --truth`), entry/data/labels and, if there is a
    table, a column for each name in entry/particles. The file is written completely or not at all.

    Raises:
        DataError: `path` exists or cannot be written.
    """
    with atomic_file(path) as partial, hdf5.created(partial) as file:
        data = new_plot(file, "data", truth.grid, "mm")
        chunks = (1, *truth.grid.shape[1:])
        data.create_dataset("data", data=truth.values, chunks=chunks)
        data["data"].attrs["units"] = truth.kind.unit("mm")
        data.create_dataset("labels", data=truth.labels, chunks=chunks, compression="gzip", compression_opts=1)
        data["labels"].attrs["names"] = ["air", *truth.names]
        for name, column in truth.table.items():
            file.create_dataset(f"entry/particles/{name}", data=column)
