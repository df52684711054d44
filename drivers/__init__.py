"""Devices of splatline: their Protocols, and the drivers of real devices."""
