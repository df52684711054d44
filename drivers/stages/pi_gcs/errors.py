"""The codes of PI GCS 2.0's error register (ERR?): meaning, advice, and whether the code refuses a command.

The vendor's and EPICS' host software agree on numbers and meanings.
"""

from __future__ import annotations

STOPPED = 10
NOT_ALLOWED_TO_MOVE = 5
UNKNOWN_COMMAND = 2

CHECK_MODEL = "Check that the controller is of the C-863 class and knows this command"
CHECK_AXIS = "Check the axis in the configuration against what SAI? lists"
CHECK_TRAVEL = "Compare the limits in the configuration with the controller's travel range (TMN?, TMX?)"
CHECK_SPEED = "Compare max_speed and acceleration in the configuration with what the controller allows"
HOME = "Search the reference first, and see that the servo is on"
LET_GO = "Give the controller back from joystick, macro or another program"
WAIT = "Wait until it stands, or stop it"
OBSTACLE = "Find what held the stage (collision, load, cable, limit switch), then close and open the driver again"
LINE = "Check the cable and the baud rate"
SERVICE = "Switch the controller off and on; if it stays, ask the vendor"

REFUSALS = {
    1: ("parameter syntax error", CHECK_MODEL),
    UNKNOWN_COMMAND: ("unknown command", CHECK_MODEL),
    3: ("command too long", LINE),
    4: ("the command could not be read", LINE),
    NOT_ALLOWED_TO_MOVE: ("a move is not possible: not referenced, or the servo is off", HOME),
    7: ("position out of limits", CHECK_TRAVEL),
    8: ("velocity out of limits", CHECK_SPEED),
    15: ("invalid axis identifier", CHECK_AXIS),
    17: ("parameter out of range", CHECK_SPEED),
    22: ("axis given twice", CHECK_AXIS),
    23: ("illegal axis", CHECK_AXIS),
    24: ("wrong number of parameters", CHECK_MODEL),
    25: ("invalid number format", CHECK_MODEL),
    26: ("parameter missing", CHECK_MODEL),
    27: ("soft limit out of range", CHECK_TRAVEL),
    31: ("the axis has no reference sensor", "Set reference to a limit switch that the stage has"),
    32: ("the axis has no limit switches", "Set reference to the reference switch, if the stage has one"),
    34: ("the command is not allowed for this stage", CHECK_MODEL),
    35: ("there is no digital input", CHECK_MODEL),
    36: ("there is no such digital output", "Check trigger_line in the configuration"),
    39: ("invalid controller number", "Connect a single controller, not a daisy chain"),
    50: ("referencing was tried while it is disabled", "Enable reference moves on the controller (RON)"),
    51: ("the axis is under joystick control", LET_GO),
    53: ("a dynamic move is in progress", WAIT),
    54: ("unknown parameter", CHECK_MODEL),
    56: ("wrong password", CHECK_MODEL),
    60: ("the parameter is protected", CHECK_MODEL),
    63: ("initialisation is running", "Wait some seconds and try again"),
    64: ("the parameter is read-only", CHECK_MODEL),
    83: ("the joystick is active", LET_GO),
    84: ("the motor is off", HOME),
    89: ("not allowed in the current motion mode", LET_GO),
    93: ("not allowed while the axis moves", WAIT),
    200: ("no stage is connected", "Check the stage's cable and the stage's name in the controller (CST?)"),
    201: ("the axis is not configured", "Check the stage's name in the controller (CST?)"),
    202: ("the axis is not there", CHECK_AXIS),
    203: ("the axis is not configured", "Check the stage's name in the controller (CST?)"),
    214: ("the position is unknown", HOME),
}
"""Code -> meaning and advice, for a refused command without other effects."""

MOTION = frozenset({45, 49, 333, 504, 505, 1024, 1025})
"""Events after which the axis may not be where it was sent: errors of the move in which they come."""
EVENTS = {
    STOPPED: ("stopped by command", "Find who stopped it before moving on"),
    45: ("the reference move failed", "Check the reference switch, its cable and what is in the stage's way"),
    49: ("the move to the limit switch failed", "Check the limit switches and what is in the stage's way"),
    76: ("its interface buffer overran", LINE),
    301: ("its send buffer overflowed", LINE),
    304: ("its receive buffer overflowed", LINE),
    307: ("a communication timeout", LINE),
    308: ("a communication timeout", LINE),
    333: ("hardware error", SERVICE),
    504: ("following error too large", OBSTACLE),
    505: ("the sensor is invalid", SERVICE),
    1024: ("motion error: the position error grew too large and the servo switched itself off", OBSTACLE),
    1025: ("the motor output limit was reached", OBSTACLE),
}
"""Code -> meaning and advice, for an event without a command."""


def meaning(code: int) -> str:
    """In words, with the number; "" for 0."""
    if code == 0:
        return ""
    words, _ = (REFUSALS | EVENTS).get(code, ("an error that this driver has no words for", ""))
    return f"error {code}, {words}"


def advice(code: int) -> str:
    _, what_to_do = (REFUSALS | EVENTS).get(code, ("", "Look the number up in the controller's manual"))
    return what_to_do
