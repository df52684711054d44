"""The base of all folders: errors, events, stop requests, child processes, memory, text, atomic files."""
