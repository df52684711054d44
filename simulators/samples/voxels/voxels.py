"""Voxels: a sample defined by a volume of attenuation, from a file or a reconstruction, with labels.

The sample is the linear interpolation between the centres of the voxels, both for projections and for the ground truth.
In a scene:

phantom:
  kind: volume
  file: thorax.nii.gz              # .tif, .npy, .npz, .nii(.gz) or .h5, next to the scene file or by its full path
  voxel_mm: 0.01                   # where the file does not state it, or to scale the sample
  window: [-1000, 1500]            # the file's values for no attenuation and the largest
  attenuation_max: 4.0             # 1/mm at the window's upper end; or largest_line_integral: 2.5
  thresholds: [-200, 300]          # the file's values at which labels begin
  names: [tissue, bone]
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from recon.base.volume import Grid
from simulators.frame.mapping import Positive
from simulators.frame.shot import CannotExposeError, Detector, Pose
from simulators.samples.bodies.solids import LEAST, MOST
from simulators.samples.sample import ReadVolume, Stored
from simulators.samples.voxels.projector import padded, project

MOST_LABELS = 255
ON = 1e-9  # a point that is closer than this to a centre counts as being on it, in voxels


@dataclass(frozen=True, eq=False)
class Voxels:
    """A volume around the rotation axis. `Voxels.of` creates it.

    Attributes:
        padded: float32 [z + 2, y + 2, x + 2], 1/mm, with one voxel of zeros on all sides.
        spacing: mm from voxel to voxel along (z, y, x).
        thresholds: in 1/mm, ascending; label k begins at the k-th threshold. None if there is a `label_volume`.
        label_volume: uint8 [z, y, x]. names: names of the labels 1, 2, ... radius: mm from the rotation axis to the
            farthest material.
    """

    padded: NDArray[np.float32]
    spacing: tuple[float, float, float]
    thresholds: tuple[float, ...] | None
    label_volume: NDArray[np.uint8] | None
    names: tuple[str, ...]
    radius: float

    @classmethod
    def of(
        cls,
        attenuation: NDArray[np.floating],
        spacing: float | tuple[float, float, float],
        thresholds: Sequence[float] | None = None,
        labels: NDArray[np.generic] | None = None,
        names: Sequence[str] = (),
    ) -> Voxels:
        """
        Args:
            attenuation: [z, y, x] in 1/mm; the rotation axis goes through the middle.
            spacing: distance between voxels in mm, one value or (z, y, x).
            thresholds: in 1/mm, ascending; a label begins at each. Without thresholds and without `labels`, every voxel
                above 0 is material.
            labels: [z, y, x], 0 ... 255; 0 is air.
            names: names of the labels from 1 on; empty: labels are named by their numbers.

        Raises:
            ValueError: the array is not a volume, values are not finite, lengths are not positive, thresholds are not
                ascending, labels have another shape, or there are too few names.
        """
        along = spacing if isinstance(spacing, tuple) else (spacing, spacing, spacing)
        if attenuation.ndim != 3 or 0 in attenuation.shape:
            raise ValueError(f"a volume has three axes [z, y, x], not the shape {attenuation.shape}")
        if not all(math.isfinite(step) and step > 0 for step in along):
            raise ValueError(f"voxels must be of positive size in mm, got {spacing}")
        if not all(LEAST <= step <= MOST for step in along):
            raise ValueError(f"voxels must be {LEAST:g} ... {MOST:g} mm in size, got {spacing}")
        volume = padded(attenuation)
        if not np.isfinite(volume).all():
            raise ValueError("the volume contains values that are not finite")
        label_volume, steps = None, None
        if labels is not None:
            if thresholds:
                raise ValueError("labels come from thresholds or from a volume, not from both")
            if labels.shape != attenuation.shape:
                raise ValueError(f"labels must have the shape of the volume, {attenuation.shape}, got {labels.shape}")
            if not np.issubdtype(labels.dtype, np.integer):
                raise ValueError(f"labels must be integers, got {labels.dtype}")
            low, n = int(labels.min()), int(labels.max())
            if not 0 <= low <= n <= MOST_LABELS:
                raise ValueError(f"labels must be 0 ... {MOST_LABELS}, got {low} ... {n}")
            label_volume = labels.astype(np.uint8)
        else:
            steps = tuple(float(t) for t in thresholds) if thresholds else (float(np.finfo(np.float32).tiny),)
            if list(steps) != sorted(set(steps)) or len(steps) > MOST_LABELS:
                raise ValueError(f"thresholds must ascend and be {MOST_LABELS} at most, got {thresholds}")
            n = len(steps)
        if names and len(names) < n:
            raise ValueError(f"{n} labels need {n} names, got {', '.join(names)}")
        named = tuple(names) if names else ("matter",) if n == 1 else tuple(f"phase_{k}" for k in range(1, n + 1))
        return cls(volume, along, steps, label_volume, named, _radius(volume, along))

    @property
    def first(self) -> tuple[float, float, float]:
        """Centre (z, y, x) of the first voxel in mm."""
        z, y, x = (-(n - 3) / 2 * step for n, step in zip(self.padded.shape, self.spacing, strict=True))
        return z, y, x

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """See Sample.line_integrals.

        Raises:
            ValueError: the number of rows of the pose is wrong.
            CannotExposeError: the source of a cone beam lies inside the volume.
        """
        pose = angle if isinstance(angle, Pose) else Pose.turned(angle, detector.shape[0])
        if pose.angle.size != detector.shape[0]:
            raise ValueError(f"the pose has {pose.angle.size} angles and the detector {detector.shape[0]} rows")
        if math.isfinite(detector.sod):
            self._check_ahead(pose, detector.sod)
        return project(self.padded, np.array(self.spacing[::-1]), np.array(self.first[::-1]), pose, detector)

    def _check_ahead(self, pose: Pose, sod: float) -> None:
        """Raises CannotExposeError if a corner of the volume is not in front of the source."""
        ends = [(first - step, -(first - step)) for first, step in zip(self.first, self.spacing, strict=True)]
        corners = np.array([(x, y, z) for z in ends[0] for y in ends[1] for x in ends[2]])
        axes, origin = pose.frames()
        along = axes[:, :, 1]
        nearest = float((along @ corners.T - np.einsum("ri,ri->r", along, origin)[:, None]).min())
        if not nearest > -sod:
            raise CannotExposeError(
                f"the volume begins {-nearest:.3g} mm in front of the rotation axis, and the source is "
                f"{sod:g} mm in front of it. All of the volume must be between source and detector: "
                "increase sod, or make voxel_mm smaller. No frame was computed"
            )

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """True attenuation in 1/mm, float32 [z, y, x]: the interpolated volume. A voxel larger than those of the volume
        gets a mean, with as many points per side as the volume has voxels there. `supersample` is for surfaces."""
        points = [
            max(1, math.ceil(wanted / own - 1e-6)) for wanted, own in zip(grid.spacing, self.spacing, strict=True)
        ]
        return self._mean(grid, points)

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """See Sample.labels. The label is that of the nearest voxel, or follows from the attenuation at the centre."""
        if self.label_volume is None:
            steps = np.array(self.thresholds, dtype=np.float32)
            return np.searchsorted(steps, self._mean(grid, [1, 1, 1]), side="right").astype(np.uint8)
        out = np.zeros(grid.shape, np.uint8)
        inside, nearest = [], []
        for centres, first, step, n in zip(
            grid.coordinates(), self.first, self.spacing, self.label_volume.shape, strict=True
        ):
            index = np.floor((centres - first) / step + 0.5).astype(np.int64)
            inside.append((index >= 0) & (index < n))
            nearest.append(index[inside[-1]])
        out[np.ix_(*inside)] = self.label_volume[np.ix_(*nearest)]
        return out

    def _mean(self, grid: Grid, points: Sequence[int]) -> NDArray[np.float32]:
        """Mean over `points` positions per side (z, y, x) in each voxel, float32 [z, y, x]. The mean is separable:
        there is one sparse matrix for each axis.
        """
        values = self.padded
        for axis, centres in enumerate(grid.coordinates()):
            weights = _weights(
                centres, grid.spacing[axis], points[axis], self.first[axis], self.spacing[axis], values.shape[0]
            )
            rest = values.shape[1:]
            # The first axis is replaced and moved to the end: after three steps all axes are in their places again.
            values = np.moveaxis((weights @ values.reshape(values.shape[0], -1)).reshape(-1, *rest), 0, 2)
        return np.ascontiguousarray(values)


def _weights(centres: NDArray[np.float64], edge: float, points: int, first: float, step: float, n: int) -> csr_array:
    """Matrix [target, padded voxel] that interpolates along one axis and takes the mean over each target voxel."""
    within = (np.arange(points) + 0.5) / points - 0.5
    place = (centres[:, None] + within * edge - first) / step + 1.0
    # Exactly the value of the voxel at its centre, because a rounded share of its neighbour would count as material.
    place = np.where(np.abs(place - np.rint(place)) < ON, np.rint(place), place)
    below = np.floor(place)
    rows = np.repeat(np.arange(centres.size), points)
    entries = []
    for column, weight in ((below, 1 - (place - below)), (below + 1, place - below)):
        inside = ((column >= 0) & (column < n)).ravel()
        entries.append((weight.ravel()[inside] / points, rows[inside], column.ravel()[inside].astype(np.int64)))
    data, row, column = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return csr_array((data.astype(np.float32), (row, column)), shape=(centres.size, n))


def _radius(volume: NDArray[np.float32], spacing: tuple[float, float, float]) -> float:
    """Distance in mm to the farthest voxel with material. The interpolation ends one voxel beyond it."""
    y, x = np.nonzero((volume != 0).any(axis=0))
    if not x.size:
        return 0.0
    across = (np.abs(x - (volume.shape[2] - 1) / 2) + 1) * spacing[2]
    down = (np.abs(y - (volume.shape[1] - 1) / 2) + 1) * spacing[1]
    return float(np.hypot(across, down).max())


MOST_COLUMNS = 100_000
VIEWS = 8  # number of projections over 180 degrees in which the largest line integral is searched


@dataclass(frozen=True)
class VolumeSettings:
    """The attenuation is linear in the values of the file: (value - low) times a factor, clipped to the window.

    Attributes:
        file: path; see ReadVolume. dataset: path in an HDF5 file, name in an .npz; needed if there is more than one
            volume. axes: order of axes in the file. voxel_mm: mm from voxel to voxel; None: the value in the file.
            window: values of the file (low, high) for 0 and the largest attenuation; None: low is 0, and no value is
            clipped.
        scale: the factor itself, 1/mm per unit of the file.
        attenuation_max: attenuation in 1/mm at the upper end of the window, or of the largest value.
            largest_line_integral: largest line integral (no unit) over the rays of 8 projections that are one voxel
                apart.
        thresholds: values of the file, ascending, at which the labels 1, 2, ... begin.
        labels: a file of labels 0 ... 255 with the same shape, instead of thresholds; `labels_dataset` is the dataset
            in it.
        names: names of the labels.
    """

    file: str
    dataset: str | None = None
    axes: str = "zyx"
    voxel_mm: Positive | None = None
    window: tuple[float, float] | None = None
    scale: Positive | None = None
    attenuation_max: Positive | None = None
    largest_line_integral: Positive | None = None
    thresholds: tuple[float, ...] = ()
    labels: str | None = None
    labels_dataset: str | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if sorted(self.axes) != ["x", "y", "z"]:
            raise ValueError(f"axes must name x, y and z in the file's order, got {self.axes!r}")
        if self.window is not None and not self.window[0] < self.window[1]:
            raise ValueError(f"window must be (low, high) in the file's values, got {self.window}")
        factors = ("scale", "attenuation_max", "largest_line_integral")
        factors_given = [name for name in factors if getattr(self, name) is not None]
        if len(factors_given) > 1:
            raise ValueError(f"{' and '.join(factors_given)} exclude each other; give one of them")
        if self.window is not None and not factors_given:
            raise ValueError("a window needs attenuation_max, largest_line_integral or scale")


def volume_sample(settings: VolumeSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises: ValueError: the file contains no volume, or the volume does not fit the settings.
    """
    stored = read(settings.file, settings.dataset)
    values = _turned(stored.values, settings)
    labels = None
    if settings.labels is not None:
        labels = _turned(read(settings.labels, settings.labels_dataset).values, settings)
    spacing = _spacing(stored, settings)
    low, high = settings.window or (0.0, math.inf)
    # float32 throughout: a volume is the largest array of a scene.
    attenuation = values.astype(np.float32)
    if settings.window is not None:
        np.clip(attenuation, low, high, out=attenuation)
        attenuation -= np.float32(low)
    factor = _factor(attenuation, spacing, settings)
    attenuation *= np.float32(factor)
    thresholds = [float(np.float32(np.float32(t) - np.float32(low)) * np.float32(factor)) for t in settings.thresholds]
    return Voxels.of(attenuation, spacing, thresholds, labels, settings.names)


def _turned(values: NDArray[np.generic], settings: VolumeSettings) -> NDArray[np.generic]:
    if values.ndim != 3 or not (np.issubdtype(values.dtype, np.integer) or np.issubdtype(values.dtype, np.floating)):
        raise ValueError(f"a volume has three axes and real values, not the shape {values.shape} of {values.dtype}")
    return values.transpose([settings.axes.index(axis) for axis in "zyx"])


def _spacing(stored: Stored, settings: VolumeSettings) -> tuple[float, float, float]:
    if settings.voxel_mm is None and stored.spacing is None:
        raise ValueError("voxel_mm is missing, and the file does not state the size of its voxels")
    own = stored.spacing or (1.0, 1.0, 1.0)
    z, y, x = (own[settings.axes.index(axis)] for axis in "zyx")
    # voxel_mm is the width of a voxel; the ratio of width to height is taken from the file.
    factor = 1.0 if settings.voxel_mm is None else settings.voxel_mm / x
    return z * factor, y * factor, x * factor


def _factor(values: NDArray[np.float32], spacing: tuple[float, float, float], settings: VolumeSettings) -> float:
    """Factor from values to attenuation in 1/mm."""
    if settings.scale is not None:
        return settings.scale
    if settings.attenuation_max is not None:
        top = settings.window[1] - settings.window[0] if settings.window else float(values.max())
        if not top > 0:
            raise ValueError(f"attenuation_max needs a value above 0; the largest is {top:g}")
        return settings.attenuation_max / top
    if settings.largest_line_integral is not None:
        whole = Voxels.of(values, spacing)
        pitch, planes = min(spacing[1:]), values.shape[0]
        across = math.ceil(math.hypot(spacing[1] * values.shape[1], spacing[2] * values.shape[2]) / pitch) + 2
        if across > MOST_COLUMNS:
            raise ValueError(
                f"voxels of {spacing[2]:g} x {spacing[1]:g} mm are too anisotropic for largest_line_integral; give "
                "attenuation_max"
            )
        detector = Detector.centred((planes, across), pitch)
        # Each row projects one plane of voxels; planes may be at any distance. Sums between planes are not larger.
        shift = np.zeros((planes, 3))
        shift[:, 2] = detector.v() * (1 - spacing[0] / pitch)
        poses = (Pose.turned(k * math.pi / VIEWS, planes).shifted_by(shift) for k in range(VIEWS))
        most = max(float(whole.line_integrals(pose, detector).max()) for pose in poses)
        if not most > 0:
            raise ValueError(f"largest_line_integral needs a sample that absorbs; the largest sum is {most:g}")
        return settings.largest_line_integral / most
    return 1.0
