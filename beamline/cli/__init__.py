"""Commands: one file each; options, output in a terminal or as JSON, exit codes."""
