"""Models: what else the Gaussians behind a volume give: voxels of any size, views, a surface."""

COMMANDS = {
    "voxelise": ("Fill voxels of any size and box from the Gaussians behind a volume.", "FITS"),
    "surface": ("Write the surface of a volume, or of its Gaussians, as a watertight mesh.", "FILES"),
    "render": ("Project the Gaussians behind a volume: views at any angle.", "FITS"),
}
