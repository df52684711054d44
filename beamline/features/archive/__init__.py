"""Archives: compressed copies of scan files, compared with them frame by frame."""

COMMANDS = {
    "archive": ("Write a compressed copy of a scan file, compared with it frame by frame.", True),
}
