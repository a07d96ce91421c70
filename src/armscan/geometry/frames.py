# SPDX-License-Identifier: Apache-2.0
"""Coordinate frames as types, so that a type checker notices a forgotten or inverted pose."""

from __future__ import annotations


class Frame:
    """A right-handed Cartesian coordinate frame; never instantiated."""


class Base(Frame):
    """Fixed base of the arm."""


class Tool(Frame):
    """What the arm's pose describes: its last link."""


class Probe(Frame):
    """Centre of the touch probe's tip."""


class Sensor(Frame):
    """The scanner head: camera 0, x to the right, y down, z forward along its optical axis."""


class CameraRight(Frame):
    """Camera 1 of a stereo head, axes as for the Sensor."""


class Board(Frame):
    """Calibration target: origin in its first point, x along a row, y along a column."""


class Plate(Frame):
    """Flat reference plate."""


class Part(Frame):
    """The object being measured."""


class Cad(Frame):
    """Coordinate frame of a CAD model."""
