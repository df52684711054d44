"""Tune: takes a few darks, flats and projections at several exposures, and finds counts, noise and the best exposure.

Pairs of frames separate noise from structure. The gain comes from photon transfer (Janesick 2007, Photon Transfer, ch.
5): it is the variance of the counts divided by their mean. The noise of a line integral p = ln(flat / view) follows by
propagation: sigma^2 = var(view) / light(view)^2 + var(flat) / (n light(flat)^2), n flats being averaged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.config.load import Config
from beamline.config.monitor import reference_limits
from beamline.config.planned import camera_settings, plan_of
from beamline.core.errors import InstrumentError
from beamline.core.events import Sink
from beamline.core.stop import StopRequest
from beamline.core.text import degrees, rounded
from beamline.instrument.connect import ConnectedDevices
from beamline.monitor.digest import digest
from beamline.monitor.evidence import Evidence, FrameStatistics
from beamline.monitor.references import ReferenceLimits, reference_findings
from beamline.plan.plan import Block, Mode, ScanPlan, Timeline
from beamline.scan.acquisition import Acquisition
from beamline.scan.ledger import LedgerError
from drivers.base.errors import DeviceRefused
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, CameraTiming, TriggerSource

F64 = NDArray[np.float64]

# factors on the configured exposure. At least one does not saturate, unless the exposure is too long by more than a
# factor of 60
SHORTER = (1.0, 1 / 8, 1 / 64)
# share of the range that the brightest pixels should reach. The rest is for top-up and drift; using it would lower the
# noise by only 1/10
TARGET = 0.8
BRIGHTEST = 99.9  # percentile of the pixels of the flat that must not saturate
DARKEST = 1.0  # percentile of the transmission that stands for the darkest part
UNLIT = 0.05  # pixels below this fraction of the highest intensity are outside the beam
BLOCK = 4  # pixels per side of a block, whose mean has little noise
# factor on the median change of a pixel from frame to frame; it is 8 standard deviations. A larger change is not noise
ZINGER = 12.0


@dataclass(frozen=True)
class Tuning:
    """The results from the frames. Counts are per pixel and frame, exposures in s."""

    configured: float  # exposure of the configuration
    exposure: float  # exposure of the flats that were used: the longest exposure that does not saturate
    saturation: float  # the largest count of the camera
    # dark, dark_noise: median of the darks, standard deviation of a pixel
    dark: float
    dark_noise: float
    # flat, brightest: median of the flat if there is beam, and 99.9th percentile of its means of 4 x 4 pixels
    flat: float
    brightest: float
    saturated: float  # fraction of the pixels of the flat that are saturated at the configured exposure
    gain: float  # counts per photon; NaN if the frames have no noise
    transmission: tuple[float, float]  # transmission of the projection: in its darkest hundredth, and the median
    # advised: exposure that brings the brightest pixels to 80 % of the range, as far as camera and period allow. NaN if
    # darks have beam or flats have none
    advised: float
    # noise: noise of a line integral in one projection at the advised exposure: in the darkest hundredth, and in the
    # median
    noise: tuple[float, float]
    longest: float  # longest exposure that the period and the camera allow
    angle: float  # angle of the projection, rad
    faults: tuple[str, ...]  # faults of darks and flats at the configured exposure
    x_rays: float = math.nan  # X-ray photons per count; NaN if optics.light_path is not known

    @property
    def photons(self) -> float:
        """Number of photons in a pixel of the flat, at the exposure of the flat."""
        return (self.flat - self.dark) / self.gain

    def lines(self) -> list[str]:
        """Lines of text; the advised exposure comes last."""
        low, middle = self.transmission
        at_low, at_middle = self.noise
        words = [
            ("dark", f"{self.dark:.5g} counts; noise of a pixel: {self.dark_noise:.3g} counts"),
            (
                "flat",
                f"{self.flat:.5g} counts; the brightest thousandth of the pixels has {self.brightest:.5g} counts "
                f"(saturation: {self.saturation:.5g}), at {self.exposure:.4g} s",
            ),
            ("saturated", f"{self.saturated:.2%} of the pixels of the flat, at the configured {self.configured:.4g} s"),
            (
                "photons",
                f"{self.photons:.4g} photons in a pixel of this flat; camera gain: {self.gain:.3g} counts per photon",
            ),
            (
                "view",
                f"transmission {middle:.3g} (median), {low:.3g} in the darkest 1 % of the projection, at "
                f"{degrees(self.angle)}",
            ),
            (
                "noise",
                f"{at_middle:.3g} (median) and {at_low:.3g} (darkest 1 % of the projection) in line integral, for "
                "one projection at the advised exposure",
            ),
            (
                "exposure",
                f"{self.advised:.4g} s: scan.exposure_s={self.advised:.4g} (now configured: {self.configured:.4g} s; "
                f"period and camera allow up to {self.longest:.4g} s)",
            ),
        ]
        if not math.isnan(self.x_rays):
            words[4:4] = [
                ("X-rays", f"{self.x_rays:.3g} photons per count, from optics.light_path (for --photons-per-count)")
            ]
        if math.isnan(self.advised):
            words[3:] = [("exposure", "not known until the fault is fixed")]
        return [f"{name:<11}{text}" for name, text in words] + [f"{'FAULT':<11}{fault}" for fault in self.faults]


def tune(
    config: Config, instrument: ConnectedDevices, stop: StopRequest, sink: Sink, angle: float | None = None
) -> Tuning:
    """Take darks, flats and projections at a few exposures, and evaluate them. No file is written.

    At the end the shutter is closed, and stage and sample are back where they were, as after a scan.

    Args:
        angle: angle of the projections in rad; None: the first angle of the plan.

    Raises: ScanStopped: a stop was requested. InstrumentError, DeviceError: a device failed.
    """
    plan, camera = plan_of(config), instrument.devices.camera
    angle = float(plan.angles[0]) if angle is None else angle
    exposures = _accepted(instrument, config, plan.exposure)
    frames, settings = take(_blocks(exposures, angle), config, instrument, stop, sink)
    timing = camera.timing
    longest = _longest(plan, settings, timing)
    tuning = evaluate(frames, plan, 2.0**timing.bits - 1, longest, reference_limits(config.references))
    path = config.optics.light_path
    return tuning if path is None else replace(tuning, x_rays=path.x_rays_per_count(tuning.gain))


def take(
    blocks: Sequence[Block], config: Config, instrument: ConnectedDevices, stop: StopRequest, sink: Sink
) -> tuple[list[Frame], CameraSettings]:
    """The frames of these blocks, kept in memory, and the settings of the camera. Raises the errors of `tune`."""
    plan, camera = plan_of(config), instrument.devices.camera
    settings = camera.configure(camera_settings(config, plan.exposure, TriggerSource.SOFTWARE))
    frame_bytes = 2 * math.prod(camera.timing.shape)
    worked = Timeline(
        blocks=tuple(blocks), duration=0.0, frame_bytes=frame_bytes, total_bytes=0, step_counts=0, step=0.0,
        blur_px=0.0, skew_px=0.0, violations=(), remarks=(), plan=plan,
    )  # fmt: skip
    instrument.watch_moves(stop.refuse_abort)
    acquisition = Acquisition(instrument.devices, worked, settings, plan.settle, instrument.clock, stop, sink)
    try:
        return list(acquisition.frames()), settings
    except LedgerError as error:
        raise InstrumentError(f"{camera.name}: frames are missing. {error}") from error


def static_block(kind: FrameKind, n: int, exposure: float) -> Block:
    """Settings of a block of frames without angles: darks or flats."""
    return Block(kind, Mode.STATIC, 0, np.full(n, np.nan), exposure, exposure)


def mean_counts(frames: Sequence[Frame]) -> F64:
    """[row, col]."""
    return np.asarray(np.mean([frame.counts for frame in frames], axis=0, dtype=np.float64))


def evaluate(
    frames: Sequence[Frame], plan: ScanPlan, saturation: float, longest: float, limits: ReferenceLimits
) -> Tuning:
    """Evaluate the frames: two darks, and two flats and one projection at each exposure.

    Args:
        longest: longest exposure in s that the result may recommend.
    """
    darks = [frame for frame in frames if frame.kind is FrameKind.DARK]
    flats = [frame for frame in frames if frame.kind is FrameKind.FLAT]
    first = max(frame.exposure for frame in flats)
    dark = mean_counts(darks)
    used = _unsaturated(flats, saturation, limits)
    pair = [frame for frame in flats if frame.exposure == used]
    (view,) = [frame for frame in frames if frame.kind is FrameKind.PROJECTION and frame.exposure == used]
    flat = mean_counts(pair)
    intensity = flat - dark
    exposed = intensity > UNLIT * np.percentile(intensity, BRIGHTEST)
    of_darks, of_flats = _variance(darks, np.ones(exposed.shape, bool)), _variance(pair, exposed)
    typical = float(np.median(intensity[exposed]))
    gain = (of_flats - of_darks) / float(intensity[exposed].mean()) if of_flats > of_darks and typical > 0 else math.nan
    through = (view.counts - dark)[exposed] / intensity[exposed]
    transmission = float(np.percentile(through, DARKEST)), float(np.median(through))
    brightest = float(np.percentile(digest(flat, preview_bin=BLOCK).preview, BRIGHTEST))
    room = (saturation * TARGET - np.median(dark)) / max(brightest - np.median(dark), 1e-9)
    references = [
        FrameStatistics.of(i, frame.kind, frame.exposure, digest(frame.counts, saturation, BLOCK), BLOCK)
        for i, frame in enumerate([*darks, *(frame for frame in flats if frame.exposure == first)])
    ]
    groups = tuple(references[: len(darks)]), tuple(references[len(darks) :])
    faults = reference_findings(Evidence(groups), limits)
    known = not any(fault.rule in ("light_in_darks", "no_beam") for fault in faults)
    advised = rounded(min(used * room, longest)) if known else math.nan
    n = max(plan.flats.count, 1)
    longer = typical * advised / used
    noise = tuple(_noise(share, longer, gain, of_darks, n) for share in transmission)
    return Tuning(
        configured=plan.exposure,
        exposure=used,
        saturation=saturation,
        dark=float(np.median(dark)),
        dark_noise=math.sqrt(of_darks),
        flat=float(np.median(flat[exposed])),
        brightest=brightest,
        saturated=float(np.mean([frame.counts >= saturation for frame in flats if frame.exposure == first])),
        gain=gain,
        transmission=transmission,
        advised=advised,
        noise=(noise[0], noise[1]),
        longest=longest,
        angle=view.angle,
        faults=tuple(fault.message for fault in faults),
    )


def _noise(share: float, intensity: float, gain: float, of_darks: float, n_flats: int) -> float:
    """Standard deviation of a line integral for this transmission; see the docstring of the module."""
    through = share * intensity
    if not through > 0:
        return math.inf
    return math.sqrt(
        (gain * through + of_darks) / through**2 + (gain * intensity + of_darks) / (n_flats * intensity**2)
    )


def _unsaturated(flats: Sequence[Frame], saturation: float, limits: ReferenceLimits) -> float:
    """The longest exposure among flats with few saturated pixels. If no flat has few, the shortest exposure."""
    shares = {
        exposure: np.mean([(frame.counts >= saturation).mean() for frame in flats if frame.exposure == exposure])
        for exposure in sorted({frame.exposure for frame in flats}, reverse=True)
    }
    return next((exposure for exposure, share in shares.items() if share <= limits.saturated), min(shares))


def _variance(pair: Sequence[Frame], where: NDArray[np.bool_]) -> float:
    """Mean variance over pixels, from the difference of two frames. Zingers, and changes of the intensity of the whole
    frame, are left out."""
    first_image, second_image = (frame.counts[where].astype(np.float64) for frame in pair[:2])
    change = first_image - second_image
    change -= np.median(change)
    squares = change**2
    return float(squares[squares <= ZINGER**2 * np.median(squares)].mean()) / 2


def _accepted(instrument: ConnectedDevices, config: Config, exposure: float) -> list[float]:
    """The exposures that the camera accepts, the longest first. Raises DeviceRefused if the camera accepts none."""
    camera = instrument.devices.camera
    taken: list[float] = []
    for share in SHORTER:
        try:
            accepted = camera.configure(camera_settings(config, exposure * share, TriggerSource.SOFTWARE))
        except DeviceRefused:
            if not taken:
                raise
            break
        taken.append(accepted.exposure)
    return taken


def _blocks(exposures: Sequence[float], angle: float) -> list[Block]:
    views = [Block(FrameKind.PROJECTION, Mode.STEP, 0, np.array([angle]), t, t) for t in exposures]
    return [
        static_block(FrameKind.DARK, 2, exposures[0]),
        *(static_block(FrameKind.FLAT, 2, exposure) for exposure in exposures),
        *views,
    ]


def _longest(plan: ScanPlan, settings: CameraSettings, timing: CameraTiming) -> float:
    """Longest exposure that, with the overhead of the camera, fits into the period of a fly scan. In a step scan the
    camera may take longer."""
    if plan.mode is not Mode.FLY:
        return math.inf
    return plan.period - max(timing.min_period - settings.exposure, timing.readout)
