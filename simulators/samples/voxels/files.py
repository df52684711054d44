"""Files: the keys of a scene for a volume of voxels, or a closed mesh of triangles, and the samples that they give.

phantom:
  kind: volume
  file: thorax.nii.gz              # .tif, .npy, .npz, .nii(.gz) or .h5, beside the scene file or by its full path
  voxel_mm: 0.01                   # where the file does not state it, or to scale the sample
  window: [-1000, 1500]            # the file's values for no attenuation and the largest
  attenuation_max: 4.0             # 1/mm at the window's upper end; or largest_line_integral: 2.5
  thresholds: [-200, 300]          # the file's values at which labels begin
  names: [tissue, bone]

    phantom: {kind: mesh, file: part.stl, unit: mm, attenuation: 2.0, voxel_mm: 0.005}

The mesh keeps its place: z of the file is the rotation axis. A voxel has the share of it that is inside the mesh.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.frame.mapping import Positive
from simulators.frame.shot import Detector, Pose
from simulators.samples.sample import ReadVolume, Stored
from simulators.samples.voxels.voxels import Voxels

MOST_COLUMNS = 100_000
VIEWS = 8  # Views over half a turn in which the largest line integral is searched


@dataclass(frozen=True)
class VolumeSettings:
    """Values of the file become attenuation linearly: (value - low) times a factor, clipped to the window.

    Attributes:
        file: path; see ReadVolume.
        dataset: path in an HDF5 file, name in an .npz; needed where there is more than one volume.
        axes: the file's order of axes.
        voxel_mm: from voxel to voxel; None: as in the file.
        window: file's values (low, high) for 0 and the largest attenuation; None: low is 0, nothing is clipped.
        scale: the factor itself, 1/mm per unit of the file.
        attenuation_max: 1/mm of the window's upper end, or of the largest value.
        largest_line_integral: dimensionless, over all rays of 8 views, a voxel apart.
        thresholds: file's values, ascending, at which labels 1, 2, ... begin.
        labels: a file of labels 0 ... 255 of the same shape, instead of thresholds; `labels_dataset` in it.
        names: of the labels.
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
        given = [name for name in factors if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other; give one of them")
        if self.window is not None and not given:
            raise ValueError("a window needs attenuation_max, largest_line_integral or scale")


def volume_sample(settings: VolumeSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises:
        ValueError: the file holds no volume, or a volume that does not fit the settings.
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
    # voxel_mm is the voxel's width; the ratio of width to height is that in the file.
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
        # Each row projects one plane of voxels, at any distance between planes. Sums between planes are not larger.
        shift = np.zeros((planes, 3))
        shift[:, 2] = detector.v() * (1 - spacing[0] / pitch)
        poses = (Pose.turned(k * math.pi / VIEWS, planes).shifted_by(shift) for k in range(VIEWS))
        most = max(float(whole.line_integrals(pose, detector).max()) for pose in poses)
        if not most > 0:
            raise ValueError(f"largest_line_integral needs matter; the largest sum is {most:g}")
        return settings.largest_line_integral / most
    return 1.0


Reals = NDArray[np.float64]

_MM = {"m": 1e3, "mm": 1.0, "um": 1e-3}
_LINES = 4  # along z through a voxel, in each of x and y
_MOST = 2**29  # voxels


@dataclass(frozen=True)
class MeshSettings:
    """The keys of a mesh in a scene.

    Attributes:
        file: .stl, .ply or .obj, beside the scene file or by its full path.
        attenuation: 1/mm, inside.
        voxel_mm: edge of the voxels that the mesh becomes; half a pixel or less.
        unit: of the lengths in the file.
        name: of its label.
    """

    file: str
    attenuation: Positive
    voxel_mm: Positive
    unit: Literal["m", "mm", "um"] = "mm"
    name: str = "matter"


def mesh_sample(settings: MeshSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises:
        ValueError: the mesh is open, or too large for its voxels.
    """
    triangles = np.asarray(read(settings.file, None).values, np.float64) * _MM[settings.unit]
    require_closed(triangles)
    share = filled(triangles, settings.voxel_mm)
    half = settings.attenuation / 2
    return Voxels.of(share * np.float32(settings.attenuation), settings.voxel_mm, [half], names=(settings.name,))


def require_closed(triangles: Reals) -> None:
    """Raises ValueError where the mesh [triangle, corner, (x, y, z)] is open: an edge lacks its way back."""
    _, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int64)
    there = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = there[there[:, 0] != there[:, 1]]
    n = np.int64(corners.max(initial=0) + 1)
    ways = np.concatenate([there[:, a] * n + there[:, 1 - a] for a in (0, 1)])
    edges, which = np.unique(ways, return_inverse=True)
    one, back = (np.bincount(half, minlength=edges.size) for half in np.split(which, 2))
    lacking = int(np.maximum(one - back, 0).sum())  # an edge of two triangles needs two ways back
    if lacking or not len(triangles):
        raise ValueError(
            f"the mesh of {len(triangles)} triangles is open: {lacking} of {len(there)} edges have no neighbour in the "
            "other direction. Close it, with all triangles anticlockwise seen from outside"
        )


def filled(triangles: Reals, voxel: float) -> NDArray[np.float32]:
    """Share of each voxel inside a closed mesh, float32 [z, y, x], symmetric about the origin.

    Along z it is exact; across it is counted on lines. Each crossing fills all that lies below it, or empties it.

    Args:
        triangles: [triangle, corner, (x, y, z)] in mm, anticlockwise seen from outside.

    Raises:
        ValueError: more voxels than `_MOST`.
    """
    half = np.ceil(np.abs(triangles).max(axis=(0, 1)) / voxel - 0.5).astype(np.int64) + 1
    x, y, z = (int(n) for n in 2 * half + 1)
    if x * y * z > _MOST:
        raise ValueError(
            f"{x} x {y} x {z} voxels of {voxel:g} mm are too many; expected {_MOST} at most: raise voxel_mm"
        )
    inside = np.zeros((z, y, x), np.float32)
    steps = np.zeros_like(inside)
    first = -(half + 0.5)
    _fill(triangles / voxel - first, _LINES, inside, steps)
    inside += np.cumsum(steps[::-1], axis=0)[::-1] - steps
    total = float(inside.sum(dtype=np.float64))
    return np.clip(inside if total >= 0 else -inside, 0, 1)  # inside out


@njit(cache=True)
def _fill(triangles: Reals, lines: int, inside: NDArray[np.float32], steps: NDArray[np.float32]) -> None:
    """Crossings of lines along z: the voxel's own share into `inside`, that of all below it into `steps`."""
    weight = 1.0 / lines**2
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        sign = weight if area > 0 else -weight
        low_x, high_x = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
        low_y, high_y = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        for i in range(int(np.ceil(low_x * lines - 0.5)), int(np.floor(high_x * lines - 0.5)) + 1):
            px = (i + 0.5) / lines
            for j in range(int(np.ceil(low_y * lines - 0.5)), int(np.floor(high_y * lines - 0.5)) + 1):
                py = (j + 0.5) / lines
                if not (
                    _left(a, b, px, py, area > 0) and _left(b, c, px, py, area > 0) and _left(c, a, px, py, area > 0)
                ):
                    continue
                wb = ((px - a[0]) * (c[1] - a[1]) - (py - a[1]) * (c[0] - a[0])) / area
                wc = ((b[0] - a[0]) * (py - a[1]) - (b[1] - a[1]) * (px - a[0])) / area
                height = a[2] + wb * (b[2] - a[2]) + wc * (c[2] - a[2])
                k = min(max(int(np.floor(height)), 0), inside.shape[0] - 1)
                inside[k, j // lines, i // lines] += sign * (height - k)
                steps[k, j // lines, i // lines] += sign


@njit(cache=True)
def _left(a: Reals, b: Reals, px: float, py: float, anticlockwise: bool) -> bool:
    """Whether a point is on the triangle's side of its edge; of two triangles at an edge just one has each point."""
    flipped = b[0] < a[0] or (b[0] == a[0] and b[1] < a[1])
    p, q = (b, a) if flipped else (a, b)
    on_left = (q[0] - p[0]) * (py - p[1]) - (q[1] - p[1]) * (px - p[0]) >= 0
    return on_left == (anticlockwise != flipped)
