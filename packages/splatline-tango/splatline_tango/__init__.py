"""Serves the running scan as a Tango device."""
