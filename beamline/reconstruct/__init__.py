"""Reconstruct: a finished or a growing scan file becomes a volume file with its report."""
