"""Scans for bluesky: its documents, and devices for its RunEngine."""
