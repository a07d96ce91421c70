# SPDX-License-Identifier: Apache-2.0
"""The two libraries by which cameras of the GenICam standard are read: Aravis and pylon."""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from armscan.devices.registry import needed_package
from armscan.errors import DeviceError, DeviceTakenError
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
_N_BUFFERS = 16
FETCH_S = 0.1
_CHUNKS = ("ChunkExposureTime", "ChunkExposureTimeAbs")
"""Where a frame bears its own exposure time in us, if the camera sends it along."""
PYLON_INSTALL = "pip install 'armscan[pylon]'"


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


class GenICamLibrary(Protocol):
    """One opened camera, by one of the libraries; any of its calls may raise anything."""

    has_short_ids: bool

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""

    def get(self, feature: str) -> Any:
        """Value of a feature."""

    def set(self, feature: str, value: Any) -> None:
        """Set a feature, within its bounds and to its increment."""

    def begin(self) -> None:
        """Start the acquisition."""

    def fetch(self) -> RawFrame | None:
        """The next frame, waiting `FETCH_S` at most."""

    def end(self) -> None:
        """Stop the acquisition."""

    def close(self) -> None:
        """Give the camera back."""


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


def _first_told(read: Callable[[str], Any]) -> float | None:
    """The exposure time that a frame bears; None where it bears none."""
    for name in _CHUNKS:
        # libraries raise whatever they like where a frame has no such part
        with suppress(Exception):
            return float(read(name))
    return None


class AravisLibrary:
    """A camera by Aravis; see `GenICamLibrary`."""

    def __init__(self, aravis: Any, camera_id: str | None) -> None:
        self._aravis = aravis
        try:
            # without it the camera's interface is not known, and no frame finds the way here
            aravis.update_device_list()
            self._camera = aravis.Camera.new(camera_id)
        except Exception as error:
            where = f"aravis:{camera_id or ''}"
            if "access" in str(error).lower() or "busy" in str(error).lower():
                raise DeviceTakenError(f"{error}", where=where) from error
            raise DeviceError(
                f"no such camera ({error})",
                where=where,
                remedy="'armscan devices --kind camera' lists those that answer",
            ) from error
        self._device = self._camera.get_device()
        self._stream: Any = None
        self._chunks: Any = None
        self._shape = 0, 0, "Mono8"
        self._is_lost = False
        self._device.connect("control-lost", self._lose)
        self.has_short_ids = aravis.Camera.is_gv_device(self._camera)

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""
        return bool(self._device.is_feature_available(feature))

    def get(self, feature: str) -> Any:
        """Value of a feature, by its own type."""
        for read in (
            self._device.get_integer_feature_value,
            self._device.get_float_feature_value,
            self._device.get_string_feature_value,
        ):
            if feature == "PixelFormat":
                return self._device.get_string_feature_value(feature)
            try:
                return read(feature)
            except Exception as error:
                last = error
        raise last

    def set(self, feature: str, value: Any) -> None:
        """Set a feature within its bounds."""
        device = self._device
        if isinstance(value, bool):
            device.set_boolean_feature_value(feature, value)
        elif isinstance(value, str):
            device.set_string_feature_value(feature, value)
        elif isinstance(value, int) or feature == "GainRaw":
            low, high = device.get_integer_feature_bounds(feature)
            step = max(device.get_integer_feature_increment(feature), 1)
            near = int(np.clip(round(value), low, high))
            device.set_integer_feature_value(feature, low + (near - low) // step * step)
        else:
            low, high = device.get_float_feature_bounds(feature)
            device.set_float_feature_value(feature, float(np.clip(value, low, high)))

    def begin(self) -> None:
        """Start the acquisition."""
        self._stream = self._camera.create_stream(None, None)
        self._chunks = self._camera.create_chunk_parser()
        payload = self._camera.get_payload()
        size = int(self.get("Width")), int(self.get("Height"))
        self._shape = *size, str(self.get("PixelFormat"))
        for _ in range(_N_BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
        self._camera.start_acquisition()

    def _lose(self, _: object) -> None:
        """The camera did not answer its heartbeat; every further call would wait for seconds."""
        self._is_lost = True

    def fetch(self) -> RawFrame | None:
        """The next frame; one with lost packets says so."""
        if self._is_lost:
            raise ConnectionError("it was unplugged, or lost its power")
        buffer = self._stream.timeout_pop_buffer(round(1e6 * FETCH_S))
        if buffer is None:
            return None
        try:
            status = self._aravis.BufferStatus
            state = buffer.get_status()
            if state in (status.CLEARED, status.ABORTED):
                return None
            # of a frame that lost packets even the size may be missing
            image = image_of(buffer.get_data(), *self._shape)
            stamp = int(buffer.get_timestamp())
            is_whole = state == status.SUCCESS
            told = _first_told(lambda name: self._chunks.get_float_value(buffer, name))
            return RawFrame(image, int(buffer.get_frame_id()), stamp or None, is_whole, told)
        finally:
            self._stream.push_buffer(buffer)

    def end(self) -> None:
        """Stop the acquisition."""
        if not self._is_lost:
            self._camera.stop_acquisition()
        self._stream = None

    def close(self) -> None:
        """Give the camera back: Aravis does so when nothing holds it, so what does is swept up."""
        self._stream = self._chunks = self._device = self._camera = None
        gc.collect()


class PylonLibrary:
    """A camera by Basler's pylon; see `GenICamLibrary`."""

    def __init__(self, pylon: Any, serial: str | None) -> None:
        self._pylon = pylon
        self._genicam = needed_package("pypylon.genicam", PYLON_INSTALL)
        where = f"pylon:{serial or ''}"
        factory = pylon.TlFactory.GetInstance()
        found = [one for one in factory.EnumerateDevices()
                 if serial is None or one.GetSerialNumber() == serial]  # fmt: skip
        if not found:
            raise DeviceError(
                "no such camera", where=where, remedy="'armscan devices --kind camera' lists them"
            )
        try:
            self._camera = pylon.InstantCamera(factory.CreateDevice(found[0]))
            self._camera.Open()
        except Exception as error:
            if "exclusive" in str(error).lower() or "use" in str(error).lower():
                raise DeviceTakenError(f"it cannot be opened ({error})", where=where) from error
            raise DeviceError(f"it cannot be opened ({error})", where=where) from error
        self._camera.MaxNumBuffer.SetValue(_N_BUFFERS)
        self._nodes = self._camera.GetNodeMap()
        self.has_short_ids = "gige" in found[0].GetDeviceClass().lower()
        tick_hz = "GevTimestampTickFrequency"
        self._tick_ns = 1e9 / self.get(tick_hz) if self.has(tick_hz) else 1.0

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""
        node = self._nodes.GetNode(feature)
        return node is not None and bool(self._genicam.IsAvailable(node))

    def get(self, feature: str) -> Any:
        """Value of a feature."""
        return self._nodes.GetNode(feature).GetValue()

    def set(self, feature: str, value: Any) -> None:
        """Set a feature within its bounds."""
        node = self._nodes.GetNode(feature)
        if isinstance(value, bool | str):
            node.SetValue(value)
            return
        near = min(max(value, node.GetMin()), node.GetMax())
        if isinstance(node.GetValue(), int):
            step, low = max(node.GetInc(), 1), node.GetMin()
            near = low + (round(near) - low) // step * step
        node.SetValue(near)

    def begin(self) -> None:
        """Start the acquisition."""
        self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def fetch(self) -> RawFrame | None:
        """The next frame; one with lost packets says so."""
        waited = round(1e3 * FETCH_S)
        result = self._camera.RetrieveResult(waited, self._pylon.TimeoutHandling_Return)
        if result is None or not result.IsValid():
            if self._camera.IsCameraDeviceRemoved():
                raise ConnectionError("it was unplugged")
            return None
        try:
            is_whole = bool(result.GrabSucceeded())
            if is_whole:
                image = np.array(result.GetArray())
            else:
                # pylon hands out no pixels of a damaged frame: its place is kept, in black
                size = int(self.get("Width")), int(self.get("Height"))
                image = image_of(b"", *size, str(self.get("PixelFormat")))
            stamp = int(result.TimeStamp)
            t_ns = round(self._tick_ns * stamp) if stamp else None
            number = int(result.BlockID)
            if number in _NO_BLOCK:
                return None
            told = _first_told(lambda name: result.ChunkDataNodeMap.GetNode(name).GetValue())
            return RawFrame(image, number, t_ns, is_whole, told)
        finally:
            result.Release()

    def end(self) -> None:
        """Stop the acquisition."""
        self._camera.StopGrabbing()

    def close(self) -> None:
        """Give the camera back."""
        self._camera.Close()
        self._camera.DestroyDevice()


_NO_BLOCK = (2**64 - 1,)
"""Told by pylon where a frame's number did not come."""
