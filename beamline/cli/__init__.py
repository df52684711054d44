"""The commands, one file for each: their options, their output in a terminal or as JSON, and their exit codes."""
