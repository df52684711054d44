"""Instrument: a configuration becomes connected devices, real or simulated."""
