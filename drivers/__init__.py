"""Devices: their Protocols, and the drivers of real devices."""
