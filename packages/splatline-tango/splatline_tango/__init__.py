"""The running scan as a Tango device."""
