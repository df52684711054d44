"""Doctor: what this computer has (camera link, ports, disk, memory) against what a scan needs."""
