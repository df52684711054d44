"""Reconstruct: from a finished or growing scan file to a volume file with its report."""
