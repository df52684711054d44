"""A device that can only be closed; it replaces a device on a port that this computer does not have."""


class Closable:
    """A device that counts how often it was closed."""

    name = "stage"

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1
