"""Serial lines: framing, ports, transcripts."""
