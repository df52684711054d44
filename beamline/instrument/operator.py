"""Ask: requests to the operator at the terminal, for manual work."""

from __future__ import annotations

import sys

if sys.platform == "win32":
    import msvcrt
else:
    import select

import click

from drivers.base.errors import DeviceError

_STATE = "What was acquired so far is in the file"


def ask_operator(request: str) -> None:
    """Ask the operator at the terminal, and wait for Enter. DeviceError: there is no terminal, or no confirmation."""
    if not sys.stdin.isatty():
        advice = "Run it in a terminal, or configure a shutter and a sample mover that need no hand"
        raise DeviceError("operator", "there is no terminal to ask at", request=request, advice=advice, state=_STATE)
    try:
        # A read from a terminal goes on after a signal, so that a stop takes effect only when it returns.
        how = "Then press Enter (to stop the scan: Ctrl-C, then Enter)"
        click.prompt(f"{request} {how}", default="", show_default=False, prompt_suffix=" ", err=True)
    except click.Abort as error:  # the end of input
        raise DeviceError("operator", "the request was not confirmed", request=request, state=_STATE) from error


def enter_pressed() -> bool:
    """Whether Enter was pressed at the terminal since the last call; False without a terminal. Does not wait."""
    pressed = False
    if not sys.stdin.isatty():
        return False
    if sys.platform == "win32":
        while msvcrt.kbhit():
            pressed |= msvcrt.getwch() in "\r\n"
    else:
        while select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline():
            pressed = True
    return pressed
