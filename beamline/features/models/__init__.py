"""Models: what else the Gaussians behind a volume give: voxels of any size, views, a surface."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "voxelise": CommandEntry(
        "beamline.features.models.command",
        "Fill voxels of any size and box from the Gaussians behind a volume.",
        Libraries.FITS,
    ),
    "surface": CommandEntry(
        "beamline.features.models.command",
        "Write the surface of a volume, or of its Gaussians, as a watertight mesh.",
        Libraries.FILES,
    ),
    "render": CommandEntry(
        "beamline.features.models.command",
        "Project the Gaussians behind a volume: views at any angle.",
        Libraries.FITS,
    ),
}
