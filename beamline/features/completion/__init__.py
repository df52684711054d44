"""Completion of commands and options in a shell."""

COMMANDS = {
    "completion": ("Print the completion script of a shell.", False),
}
