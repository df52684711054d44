"""Quantity of a volume's voxels, and its unit."""

from __future__ import annotations

from enum import Enum


class VoxelKind(Enum):
    """The physical quantity of the voxels."""

    ATTENUATION = "attenuation"
    """Linear attenuation coefficient, of views in transmission."""
    ACTIVITY = "activity"
    """Counts per length of a line of response, of a sample that emits."""
    SHARE = "volume fraction"
    """Share of the voxel that a material fills, without a unit."""

    def unit(self, length: str) -> str:
        """Unit of a voxel, with lengths in `length`, "mm" or "px"; empty for shares."""
        return {self.ATTENUATION: f"1/{length}", self.ACTIVITY: f"counts/{length}", self.SHARE: ""}[self]

    def label(self, length: str) -> str:
        """Label of an axis or a colour bar: the quantity and its unit."""
        unit = self.unit(length)
        return f"{self.value} ({unit})" if unit else self.value

    @classmethod
    def of_unit(cls, unit: str) -> VoxelKind:
        """The kind of voxels with this unit; attenuation if no kind has the unit that a file states."""
        return cls.SHARE if unit == "" else cls.ACTIVITY if unit.startswith("counts/") else cls.ATTENUATION
