"""Families of devices, each a folder.

To add a family, add its folder. Its SHUTTERS, FILTERS, MONOCHROMATORS and BEAM_MONITORS are sections of the
configuration by `kind`. These sections derive from `FoundShutter` and similar classes, and connect the device.
"""
