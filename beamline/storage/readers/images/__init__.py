"""Scans stored as images: a folder or .zip of image files, or one TIFF with a page for each frame."""

FORMATS = {
    "tiff_series": "beamline.storage.readers.images.tiff_series",
    "tiff_stack": "beamline.storage.readers.images.tiff_stack",
}
