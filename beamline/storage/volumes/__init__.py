"""Files that hold a volume, by format."""
