"""Volumes stored as TIFF: one file with a page per slice, or a folder with a file per slice."""

from beamline.storage.volumes import FormatEntry

_MODULE = "beamline.storage.volumes.images.tiff"
FORMATS = {
    "tiff": FormatEntry(_MODULE, "TiffVolume", (".tif", ".tiff")),
    "tiff_folder": FormatEntry(_MODULE, "TiffFolderVolume", ("",), "a folder of TIFFs"),
}
