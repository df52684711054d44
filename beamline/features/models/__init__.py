"""Models: what else the Gaussians behind a volume give: voxels of any size, views, a surface."""

COMMANDS = {
    "voxelise": ("Fill voxels of any size and box from the Gaussians behind a volume.", True),
    "surface": ("Write the surface of a volume, or of its Gaussians, as a watertight mesh.", True),
    "render": ("Project the Gaussians behind a volume: views at any angle.", True),
}
