"""Basics for all other folders: errors, events, stop requests, child processes, memory, text, safe writing of files."""
