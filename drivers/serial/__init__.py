"""Serial lines: requests and replies, ports, and transcripts of the dialogue."""
