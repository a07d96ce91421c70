# SPDX-License-Identifier: Apache-2.0
"""Frames as industrial cameras deliver them: pixels, count and exposure time, as far as told."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from armscan.errors import DeviceError
from armscan.geometry.arrays import ImageArray
from armscan.records.recording import PixelColour

FORMATS: dict[str, tuple[int, PixelColour]] = {
    "Mono8": (8, "mono"),
    "Mono10": (10, "mono"),
    "Mono12": (12, "mono"),
    "Mono16": (16, "mono"),
    "BayerRG8": (8, "bayer_rggb"),
    "BayerRG10": (10, "bayer_rggb"),
    "BayerRG12": (12, "bayer_rggb"),
    "RGB8": (8, "rgb"),
    "RGB8Packed": (8, "rgb"),
}
_CHUNKS = ("ChunkExposureTime", "ChunkExposureTimeAbs")
"""Where a frame bears its own exposure time in us, if the camera sends it along."""
SHORT_IDS = 65_535
"""GigE Vision 1 counts frames from 1 to this and then begins again at 1."""
UNDER_WAY, UNDER_WAY_NS = 3, 100_000_000
"""So many frames, and all that came so soon, may still have been exposed as before a change."""
SMALL_CHANGE_NS = 50_000
"""A change by less moves no middle by more than 25 us."""


@dataclass(frozen=True, slots=True)
class RawFrame:
    """What a library delivers.

    Parameters
    ----------
    number
        The camera's own count.
    t_camera_ns
        Its time at the start of the exposure; None for a camera without clock.
    is_complete
        False where packets were lost.
    exposure_us
        As the frame itself tells; None where it does not.
    """

    image: ImageArray
    number: int
    t_camera_ns: int | None
    is_complete: bool
    exposure_us: float | None = None


def image_of(data: bytes, width: int, height: int, form: str) -> ImageArray:
    """An array of its own of (H, W) or (H, W, 3) pixels; missing bytes at the end are black."""
    if form not in FORMATS:
        raise DeviceError(
            f"pixels of the format {form} are not read",
            remedy=f"set PixelFormat to one of {', '.join(FORMATS)}",
        )
    bits, colour = FORMATS[form]
    dtype: Any = np.uint8 if bits == 8 else np.uint16
    shape = (height, width, 3) if colour == "rgb" else (height, width)
    flat = np.zeros(int(np.prod(shape)), dtype)
    came = np.frombuffer(data, dtype, count=min(len(data) // flat.itemsize, len(flat)))
    flat[: len(came)] = came
    return np.asarray(flat.reshape(shape))


def first_told(read: Callable[[str], Any]) -> float | None:
    """The exposure time that a frame bears; None where it bears none."""
    for name in _CHUNKS:
        # libraries raise whatever they like where a frame has no such part
        with suppress(Exception):
            return float(read(name))
    return None


class ContinuedCount:
    """A count that goes on where a camera's own begins anew."""

    def __init__(self) -> None:
        self._last = -1
        self._base: int | None = 0
        self._turn = 0

    def begin_anew(self, has_short_ids: bool) -> None:
        """The device counts from its beginning again, after a start."""
        self._turn = SHORT_IDS if has_short_ids else 0
        self._base = None

    def of(self, number: int) -> int:
        """The frame's number among all since its camera was opened."""
        if self._base is None:
            self._base = self._last + 1 - number
        while self._turn and number + self._base < self._last - self._turn // 2:
            self._base += self._turn
        self._last = number + self._base
        return self._last


class ExposureInUse:
    """The exposure time of frames that do not tell their own; any thread may ask.

    After a change nobody tells which frame is the first of the new time. Until all that were under
    way must have come, the shorter one is told, with which no arrival is too early, as not sure.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._possible_ns: tuple[int, ...] = (0,)
        self._is_changing = False
        self._settled_ns = self._n_since = 0

    def begin_change(self, wished_us: float) -> None:
        """Another time is about to be set."""
        with self._lock:
            self._possible_ns = (*self._possible_ns, round(1e3 * wished_us))
            self._is_changing = True

    def settle(self, exposure_us: float | None) -> None:
        """This one is set now; without a change that was begun, nothing else is under way."""
        with self._lock:
            set_ns = round(1e3 * (exposure_us or 0.0))
            if self._is_changing:
                self._settled_ns, self._n_since = time.monotonic_ns(), 0
                self._possible_ns = (min(self._possible_ns), max(self._possible_ns), set_ns)
            else:
                self._possible_ns = (set_ns,)
            self._is_changing = False

    def of_frame(self, t_host_ns: int, told_us: float | None = None) -> tuple[int, bool]:
        """Exposure time in ns of a frame, by its own word if it has one, and whether it is sure."""
        if told_us is not None:
            return round(1e3 * told_us), True
        with self._lock:
            self._n_since += 1
            is_late = t_host_ns > self._settled_ns + UNDER_WAY_NS
            if not self._is_changing and is_late and self._n_since > UNDER_WAY:
                self._possible_ns = self._possible_ns[-1:]
            least, most = min(self._possible_ns), max(self._possible_ns)
            is_sure = most - least <= SMALL_CHANGE_NS
            return (self._possible_ns[-1] if is_sure else least), is_sure
