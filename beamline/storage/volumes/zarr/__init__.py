"""Volumes stored as OME-Zarr."""

from beamline.storage.volumes import FormatEntry

FORMATS = {"ome_zarr": FormatEntry("beamline.storage.volumes.zarr.ome_zarr", "OmeZarr", (".zarr",))}
