"""Doctor: checks of this computer (camera link, ports, disk, memory) against the needs of a scan."""
