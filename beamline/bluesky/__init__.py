"""Scans in bluesky: its documents, and devices for its RunEngine."""
