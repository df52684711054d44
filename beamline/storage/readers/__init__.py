"""Readers: scan files of any format, behind one interface (Protocol)."""
