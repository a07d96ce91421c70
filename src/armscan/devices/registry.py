# SPDX-License-Identifier: Apache-2.0
"""Devices by address: ``webcam:0`` is the driver's name, a colon, and what that driver opens.

A driver is an entry point of the group ``armscan.devices``. Drivers that come with armscan and
those of other packages are found alike.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, overload
from urllib.parse import parse_qsl

from armscan.devices.protocols import (
    Arm,
    Camera,
    DeviceDriver,
    DeviceInfo,
    DeviceKind,
    LaserController,
)
from armscan.errors import DeviceError, DriverMissingError, OptionError, shown

DEVICE_GROUP = "armscan.devices"


@dataclass(frozen=True, slots=True)
class DriverReport:
    """One driver that is installed, and what it finds.

    Parameters
    ----------
    name
        First part of the addresses that it opens.
    kinds
        What it opens; empty where its module cannot be loaded.
    found
        Devices that are there now.
    problem
        Why it finds nothing: a package that is missing and how to install it, or what failed.
    """

    name: str
    kinds: tuple[DeviceKind, ...]
    found: tuple[DeviceInfo, ...] = ()
    problem: str = ""


@overload
def open_device(kind: Literal["camera"], address: str) -> Camera: ...
@overload
def open_device(kind: Literal["arm"], address: str) -> Arm: ...
@overload
def open_device(kind: Literal["lasers"], address: str) -> LaserController: ...
@overload
def open_device(kind: DeviceKind, address: str) -> Camera | Arm | LaserController: ...
def open_device(kind: DeviceKind, address: str) -> Camera | Arm | LaserController:
    """Open the device at an address: driver and place, for example ``tcp:127.0.0.1:4712``.

    Raises
    ------
    OptionError
        If no driver has that name, or its part of the address cannot be read.
    DriverMissingError
        If a package that the driver needs is not installed.
    DeviceTakenError
        If somebody else has the device open.
    """
    name, _, place = address.partition(":")
    driver = _load(_entry_point(name, address))
    if kind not in driver.kinds:
        raise DeviceError(
            f"the driver '{name}' opens {_listed(driver.kinds)}, not {_listed([kind])}",
            where=address,
            remedy="name another device",
        )
    return driver.open(kind, place)


def device_drivers() -> tuple[str, ...]:
    """Names with which addresses of devices begin, sorted."""
    return tuple(sorted(entry_points(group=DEVICE_GROUP).names))


def survey_drivers() -> tuple[DriverReport, ...]:
    """Ask all installed drivers, sorted by name, what they find."""
    return tuple(_survey(_entry_point(name, name)) for name in device_drivers())


def _survey(point: EntryPoint) -> DriverReport:
    kinds: tuple[DeviceKind, ...] = ()
    try:
        driver = _load(point)
        kinds = driver.kinds
        return DriverReport(point.name, kinds, driver.discover())
    except DeviceError as error:
        return DriverReport(point.name, kinds, problem=str(error))
    except Exception as error:
        # Somebody else's driver must not take the list with it.
        return DriverReport(
            point.name, kinds, problem=shown(f"it failed: {type(error).__name__}: {error}")
        )


def _entry_point(name: str, address: str) -> EntryPoint:
    found = entry_points(group=DEVICE_GROUP, name=name)
    if not name or not found:
        known = sorted(entry_points(group=DEVICE_GROUP).names)
        raise OptionError(
            f"no driver is called '{name}'",
            where=address,
            remedy=f"begin the address with one of {', '.join(known) or '(none is installed)'} and "
            "a colon",
        )
    return next(iter(found))


def _load(point: EntryPoint) -> DeviceDriver:
    try:
        loaded: DeviceDriver = point.load()
    except (ImportError, AttributeError) as error:
        raise DriverMissingError(
            f"the driver '{point.name}' cannot be loaded ({error})",
            remedy="install its package again",
        ) from error
    return loaded


def needed_package(module: str, install: str) -> Any:
    """Import what a driver needs when it is first used; ``install`` says how to get it.

    Raises
    ------
    DriverMissingError
        If it is not there, with that remedy.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise DriverMissingError(
            f"the package '{module.partition('.')[0]}' is not installed ({error})", remedy=install
        ) from error


def split_place(place: str, known: Iterable[str]) -> tuple[str, dict[str, str]]:
    """Part an address behind the driver's name: ``plate?rate=10`` is a place and its options.

    Raises
    ------
    OptionError
        If an option is unknown, has no value or stands twice.
    """
    path, _, query = place.partition("?")
    options: dict[str, str] = {}
    allowed = sorted(known)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        pairs = [("?", "")]
    for key, value in pairs:
        if key not in allowed or not value or key in options:
            raise OptionError(
                f"'{query}' is no list of options that this driver knows",
                where=place,
                remedy=f"write key=value, joined by &, each once; keys are {', '.join(allowed)}",
            )
        options[key] = value
    return path, options


def number_option(options: dict[str, str], key: str, default: float, most: float) -> float:
    """The number that an option of an address gives, 0 to ``most``.

    Raises
    ------
    OptionError
        If it is no such number.
    """
    value = -1.0
    with suppress(ValueError):
        value = float(options.get(key, default))
    if not 0.0 <= value <= most:
        raise OptionError(
            f"{key}={options[key]} is no number of 0 to {most:g}", remedy="correct the address"
        )
    return value


def _listed(kinds: Iterable[str]) -> str:
    names = {"camera": "cameras", "arm": "arms", "lasers": "laser controllers"}
    return " and ".join(names[kind] for kind in kinds)
