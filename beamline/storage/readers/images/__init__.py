"""Scans of images: a folder or .zip of them, one TIFF with a page a frame, or a scene of R²-Gaussian."""

FORMATS = {
    "scene": "beamline.storage.readers.images.scene",
    "tiff_series": "beamline.storage.readers.images.tiff_series",
    "tiff_stack": "beamline.storage.readers.images.tiff_stack",
}
