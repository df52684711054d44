"""What everything else stands on: errors, events, stop requests, text, memory, files written whole or not at all."""
