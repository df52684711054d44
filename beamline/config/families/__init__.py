"""Families of devices, each a folder.

To add a family, add its folder. The tables SHUTTERS, FILTERS, MONOCHROMATORS and BEAM_MONITORS of the folder contain
sections of the configuration by `kind`. These sections derive from `FoundShutter` and similar classes, and connect the
device.
"""
