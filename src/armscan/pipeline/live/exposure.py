# SPDX-License-Identifier: Apache-2.0
"""Exposure time of the cameras while they run: the laser's line as bright as it should be.

The line's brightness is read from the images themselves, so that it is known before anything is
calibrated: the brightest pixel of every few columns or rows is the line, where a line crosses them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.devices.protocols import Camera, CameraSettings, Frame
from armscan.errors import DeviceError, OptionError
from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.records.recording import CameraSetup

ExposureMode = Literal["fixed", "automatic", "reflective"]

EVERY_PX = 8
"""Every such column or row is looked at: two hundred of them tell a median to a few percent."""
GLINT_QUANTILE = 0.95
"""Of a reflective part the brightest twentieth of the line decides: glints must not saturate."""
SATURATED = 0.98
"""Grey levels from this part of full scale on tell no more than that they are too bright."""
CLIPPED_STEP = 0.5
"""Nobody knows how much too bright a saturated line is: it is halved until it is not."""
LARGEST_STEP = 2.0
NEAR_ENOUGH = 0.1
"""Within this part of the wanted brightness nothing is changed."""
LEAST_CONTRAST = 0.03
"""Of full scale: what rises less above the ground is no line, and the image too dark."""
EVERY_S = 0.25
"""So often a camera is set at most."""
IMAGES_UNDER_WAY = 3
"""Images after a new setting that may have been taken before it: cameras expose one while they
read another out, and a third is on the line."""
SEEN_LATELY_S = 2.0
"""Lasers that take turns share one exposure time, that of the brightest seen so lately."""
SHOWN_S = 10.0
"""So long a person is told how bright a line was."""


@dataclass(frozen=True, slots=True)
class LaserTarget:
    """How bright the line of one source should be.

    Parameters
    ----------
    laser
        Name of the source.
    target
        As of `ExposureSettings`.
    """

    laser: str
    target: float


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """How long cameras expose while they scan.

    Parameters
    ----------
    mode
        ``fixed`` leaves what is set; ``automatic`` brings the middle of the line's brightness to
        the target; ``reflective`` its brightest twentieth, for parts with glints.
    exposure_us, gain_db
        Set at the start; 0 and None leave the camera's own.
    target
        Wanted peak of the line, as a part of full scale.
    least_us, most_us
        Bounds of the exposure time; longer ones blur a line that moves.
    laser
        Sources with a target of their own.

    Raises
    ------
    OptionError
        If a target is not between 0.05 and 0.95, or the bounds are not in order.
    """

    mode: ExposureMode = "fixed"
    exposure_us: float = 0.0
    gain_db: float | None = None
    target: float = 0.7
    least_us: float = 20.0
    most_us: float = 5000.0
    laser: tuple[LaserTarget, ...] = ()

    def __post_init__(self) -> None:
        for target in (self.target, *(one.target for one in self.laser)):
            if not 0.05 <= target <= 0.95:
                raise OptionError(
                    f"a target of {target:g}", remedy="give 0.05 to 0.95 of full scale"
                )
        if not 0.0 < self.least_us <= self.most_us or self.exposure_us < 0.0:
            raise OptionError(
                f"exposure times from {self.least_us:g} to {self.most_us:g} us",
                remedy="give a least time above 0 and a longest above it",
            )

    def target_of(self, lasers: tuple[str, ...]) -> float:
        """Wanted peak of the line where these sources are on: the least of their targets."""
        own = {one.laser: one.target for one in self.laser}
        return min((own.get(name, self.target) for name in lasers), default=self.target)


@dataclass(frozen=True, slots=True)
class LineBrightness:
    """How bright a line was when its camera was last looked at.

    Parameters
    ----------
    lasers
        Sources that were on; empty where it is not known.
    level
        Of the part of the line that decides, as a part of full scale; None where none is seen.
    target
        Wanted level.
    exposure_us
        Time of the image.
    seen_s
        When, by this computer's monotonic clock.
    """

    lasers: tuple[str, ...]
    level: float | None
    target: float
    exposure_us: float
    seen_s: float

    @property
    def words(self) -> str:
        """For a person."""
        level = "no line is seen" if self.level is None else f"line at {self.level:.0%}"
        name = f"{'+'.join(self.lasers)}: " if self.lasers else ""
        return f"{name}{self.exposure_us:.0f} us, {level}, {self.target:.0%} wanted"


def line_levels(image: ImageArray, full_scale: int) -> tuple[FloatArray, float]:
    """Brightest pixels across the line, and the ground, as parts of full scale.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3); of colour the brightest channel counts.
    full_scale
        Grey level of saturation.

    Returns
    -------
    peaks
        (N,) maximum of every few columns, or rows where those are the brighter ones.
    ground
        Median of the image.
    """
    sparse = image[::EVERY_PX, ::EVERY_PX]
    ground = float(np.median(sparse if image.ndim == 2 else sparse.max(axis=2)))
    colours = (image.ndim - 2) * (2,)
    columns = image[:, ::EVERY_PX].max(axis=(0, *colours))
    rows = image[::EVERY_PX].max(axis=(1, *colours))
    found = columns if np.median(columns) >= np.median(rows) else rows
    return found / full_scale, ground / full_scale


def deciding_level(peaks: FloatArray, ground: float, mode: ExposureMode) -> float | None:
    """Brightness of the part of the line that decides; None where no line is seen.

    Parameters
    ----------
    peaks, ground
        From `line_levels`.
    mode
        Which part decides.
    """
    level = float(np.quantile(peaks, GLINT_QUANTILE) if mode == "reflective" else np.median(peaks))
    return None if level - ground < LEAST_CONTRAST else level


def wanted_factor(level: float | None, ground: float, target: float) -> float | None:
    """By what the exposure time is to be multiplied; None where no line is seen.

    Light is linear in time: what rises above the ground grows with it.

    Parameters
    ----------
    level, ground
        From `deciding_level` and `line_levels`, parts of full scale.
    target
        Wanted peak, part of full scale.
    """
    if level is None:
        return None
    if level >= SATURATED:
        return CLIPPED_STEP
    factor = max(target - ground, LEAST_CONTRAST) / (level - ground)
    if abs(factor - 1.0) < NEAR_ENOUGH:
        return 1.0
    return float(np.clip(factor, 1.0 / LARGEST_STEP, LARGEST_STEP))


class ExposureControl:
    """Sets one camera from the images that it is shown, in a thread of its own.

    A camera that is slow to answer keeps nobody waiting: images shown meanwhile are passed over.
    Where no line is seen at all the time grows to the longest: the line may be too dark.

    Parameters
    ----------
    camera
        To be set.
    settings
        How.
    tell
        Told of every new setting, and of a camera that refuses one.
    """

    def __init__(
        self,
        camera: Camera,
        settings: ExposureSettings,
        tell: Callable[[CameraSettings | DeviceError], None],
    ) -> None:
        self._camera, self._settings, self._tell = camera, settings, tell
        self._setup: CameraSetup = camera.setup
        self._shown: tuple[Frame, tuple[str, ...]] | None = None
        self._changed = threading.Condition()
        self._n_under_way = 0
        self._is_over = False
        self._seen: dict[tuple[str, ...], tuple[LineBrightness, float]] = {}
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Set what is given, and begin to look at images.

        Raises
        ------
        DeviceError
            If the camera does not take it.
        """
        given = self._settings
        if given.exposure_us or given.gain_db is not None:
            wished = CameraSettings(exposure_us=given.exposure_us or None, gain_db=given.gain_db)
            self._tell(self._camera.configure(wished))
        if given.mode != "fixed":
            self._is_over = False
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def show(self, frame: Frame, lasers: tuple[str, ...] | None) -> None:
        """Show an image and what was on; one without laser tells nothing. Returns at once."""
        if lasers != () and frame.is_complete and self._settings.mode != "fixed":
            with self._changed:
                self._n_under_way -= 1
                if self._n_under_way < 0:
                    self._shown = frame, lasers or ()
                    self._changed.notify()

    @property
    def brightness(self) -> tuple[LineBrightness, ...]:
        """Of the lines that were seen lately, one a choice of lasers; none where all is fixed."""
        now_s = time.monotonic()
        found = (one for one, _ in tuple(self._seen.values()))
        return tuple(one for one in found if now_s - one.seen_s < SHOWN_S)

    def stop(self) -> None:
        """Look at no more images."""
        with self._changed:
            self._is_over = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def adjust(self, frame: Frame, lasers: tuple[str, ...]) -> CameraSettings | None:
        """Look at one image and set the camera; returns what it took, None if nothing changed.

        Raises
        ------
        DeviceError
            If the camera does not answer.
        """
        now_us = self._camera.settings.exposure_us
        if now_us is None:
            return None
        given, now_s = self._settings, time.monotonic()
        image, bits = frame.image, self._setup.bits_used
        full = ((1 << bits) - 1) << (
            8 * image.dtype.itemsize - bits if self._setup.align == "high" else 0
        )
        peaks, ground = line_levels(image, full)
        level, target = deciding_level(peaks, ground, given.mode), given.target_of(lasers)
        factor = wanted_factor(level, ground, target)
        seen = LineBrightness(lasers, level, target, now_us, now_s)
        self._seen[lasers] = seen, now_us * (LARGEST_STEP if factor is None else factor)
        lately = [us for one, us in self._seen.values() if now_s - one.seen_s < SEEN_LATELY_S]
        wanted_us = float(np.clip(min(lately), given.least_us, given.most_us))
        if abs(wanted_us / now_us - 1.0) < NEAR_ENOUGH:
            return None
        return self._camera.configure(CameraSettings(exposure_us=wanted_us))

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._shown is None and not self._is_over:
                    self._changed.wait()
                if self._is_over or self._shown is None:
                    return
                frame, lasers = self._shown
                self._shown = None
            took = None
            try:
                took = self.adjust(frame, lasers)
            except DeviceError as error:
                self._tell(error)
            except Exception as error:  # of somebody's driver: told, and tried again
                self._tell(DeviceError(f"{type(error).__name__}: {error}", where=self._camera.name))
            else:
                if took is not None:
                    self._tell(took)
            with self._changed:
                if took is not None:
                    self._n_under_way = IMAGES_UNDER_WAY
                self._changed.wait_for(lambda: self._is_over, EVERY_S)
                self._shown = None
