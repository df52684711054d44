"""Commands, one file each; their options, their output in a terminal or as JSON, and exit codes."""
