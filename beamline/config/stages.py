"""Configuration of the rotation stage: which controller, where it is, its figures and its trigger output."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, PositiveFloat, PositiveInt, model_validator

from beamline.config.section import Section
from drivers.stages.zaber.train import PulseSettings, pulses_of


class _Stage(Section):
    """What every stage has. Real ports: COM3, /dev/ttyUSB0, /dev/serial/by-id/..., socket://host:port."""

    kind: str
    port: Annotated[str, Field(min_length=1)]
    """Where its controller is; sim:// and the kind is its simulated counterpart, which takes all else from here."""
    counts_per_turn: PositiveInt
    """Motor pulses or encoder counts for 360 deg; triggers fall on whole ones."""
    max_speed_deg_s: PositiveFloat
    acceleration_deg_s2: PositiveFloat
    low_deg: FiniteFloat = -5.0
    high_deg: FiniteFloat = 365.0
    """The stage is never sent beyond low_deg and high_deg."""
    timeout_s: PositiveFloat = 1.0
    """For a reply."""
    baudrate: PositiveInt
    pulse_width_s: PositiveFloat | None = None
    """Of the trigger pulses; null: the driver's choice, or what the controller has."""
    active_high: bool = True
    """Trigger pulses are high; refused where the controller has no such choice."""
    transcript: str | None = None
    """A file to which every byte to and from the controller is appended with its time; null: none."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if not self.low_deg < self.high_deg:
            raise ValueError(f"low_deg {self.low_deg} must lie below high_deg {self.high_deg}")
        if self.simulated and self.port.lower() != f"sim://{self.kind}":
            raise ValueError(f"port {self.port} is not the simulated counterpart of {self.kind}, sim://{self.kind}")
        return self

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")


class PM16CStageConfig(_Stage):
    """Tsuji PM16C-04XD pulse-motor controller on a serial port, a TCP port or simulated."""

    kind: Literal["pm16c"]
    channel: Annotated[int, Field(ge=0, le=15)] = 0
    baudrate: PositiveInt = 9600
    first_pulse: Literal["at_start", "interval_after"] = "at_start"
    """Where the firmware puts a train's first pulse: at its start point (from memory), or an interval behind it."""
    home_deg: FiniteFloat | None = None
    """Where its home switch is; null: it has none, and no search is made."""
    home_speed_deg_s: PositiveFloat | None = None
    """For the search; null: a tenth of max_speed_deg_s."""

    @model_validator(mode="after")
    def _polarity_is_fixed(self) -> Self:
        if not self.active_high:
            raise ValueError("active_high cannot be false: the PM16C's trigger output has one polarity")
        return self


class PiGcsStageConfig(_Stage):
    """Physik Instrumente controller that talks GCS 2.0, with triggers from CTO and TRO, such as a C-863."""

    kind: Literal["pi_gcs"]
    axis: Annotated[str, Field(pattern=r"^\w{1,16}$", description="1 to 16 letters, digits and _")] = "1"
    trigger_line: PositiveInt = 1
    """Digital output that the trigger pulses come from."""
    baudrate: PositiveInt = 115_200
    reference: Literal["switch", "negative_limit", "positive_limit"] = "switch"
    """What the search for the reference goes to."""
    first_pulse: Literal["at_threshold", "step_after", "grid"] = "at_threshold"
    """Where the firmware puts a train's first pulse; not documented, to be found out once (docs/hardware.md)."""
    firmware_pulse_s: PositiveFloat = 50e-6
    """How long the firmware holds a pulse."""
    tolerance_counts: Annotated[int, Field(ge=0)] = 10
    """From the target, within which a move has arrived."""
    settle_s: Annotated[float, Field(ge=0)] = 1.0
    """After a move, in which the controller may still bring the axis on target."""

    @model_validator(mode="after")
    def _width_is_the_firmware_s(self) -> Self:
        if self.pulse_width_s is not None:
            raise ValueError("pulse_width_s cannot be set: the firmware of a pi_gcs controller fixes it; set null")
        return self


class ZaberStageConfig(_Stage):
    """Zaber stage that talks ASCII, firmware 7.06 or later, with triggers on a digital output."""

    kind: Literal["zaber"]
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    output: PositiveInt = 1
    """Digital output that the trigger pulses come from."""
    baudrate: PositiveInt = 115_200
    toggle: bool = False
    """Each fire toggles the output (firmware without `schedule`): every second one is a pulse, intervals are even."""
    speed_unit: PositiveFloat = 1.6384
    """Native speed per microstep/s; the vendor's convention, from memory."""
    measured: bool = False
    """Pulses by the encoder, not by the commanded position."""
    chained: bool = True
    """An action may enable another trigger; false: arming turns the stage to one step before the first pulse."""
    fires_when_enabled: bool = False
    """A distance trigger fires where it is enabled, too."""
    starter: PositiveInt = 1
    repeater: PositiveInt = 2
    """The numbers of the two triggers used."""
    shortest_s: PositiveFloat = 1e-3
    """Between two fires at full speed."""

    @model_validator(mode="after")
    def _possible_pulses(self) -> Self:
        self.pulses()
        return self

    def pulses(self) -> PulseSettings:
        """How the driver is to make them. Raises ValueError where no output can."""
        rest = PulseSettings(
            measured=self.measured,
            chained=self.chained,
            fires_when_enabled=self.fires_when_enabled,
            starter=self.starter,
            repeater=self.repeater,
            shortest=self.shortest_s,
        )
        return pulses_of(
            rest, output=self.output, width=self.pulse_width_s, active_high=self.active_high, toggle=self.toggle
        )


StageConfig = PM16CStageConfig | PiGcsStageConfig | ZaberStageConfig
