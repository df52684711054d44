"""Zaber rotary stages (ASCII protocol)."""
