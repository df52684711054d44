"""The Gaussians behind a volume as a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamline.core.files import whole_file
from beamline.gaussians.model import Model


def write_ply(path: Path, model: Model) -> None:
    """The Gaussians as a binary PLY: x y z, scale_0..2 (standard deviations), rot_0..3 (w x y z), density.

    Raises:
        DataError: `path` exists, or the disk refuses; nothing is left.
    """
    arrays, unit = model.gaussians.physical(), model.record.length_unit
    names = ("x", "y", "z", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "density")
    columns = (arrays["centres"], arrays["widths"], arrays["rotations"], arrays["densities"][:, None])
    rows = np.concatenate(columns, axis=1).astype("<f4")
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment lengths in {unit}, densities in {model.record.unit}, kernel {model.gaussians.kernel}",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode())
        file.write(rows.tobytes())
