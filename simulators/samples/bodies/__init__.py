"""Bodies: solids with exact chord lengths."""
