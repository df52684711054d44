"""Families of devices, each a folder.

Adding one takes its folder, whose SHUTTERS, FILTERS, MONOCHROMATORS and BEAM_MONITORS are sections of the configuration
by `kind`. They derive from `FoundShutter` and others like it, and connect the device.
"""
