"""Devices: their Protocols, and drivers for real ones."""
