"""Storage: readers, writers and rules of scan, volume and checkpoint files."""
