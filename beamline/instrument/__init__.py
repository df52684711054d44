"""Instrument: connects the devices of a configuration, real or simulated."""
