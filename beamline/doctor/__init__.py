"""Doctor: checks of this computer against the needs of a scan, and the rate at which it takes frames."""
