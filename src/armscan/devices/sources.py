# SPDX-License-Identifier: Apache-2.0
"""Sources of a scan, and the registry in which drivers are found by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any, Literal, Protocol

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, CameraRight, Part, Pose, Sensor, Tool
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session


class ScanSource(Protocol):
    """One scan that can be read again and in any order."""

    @property
    def name(self) -> str:
        """What messages and reports call it."""

    @property
    def session(self) -> Session:
        """Cameras, clock and form of the poses."""

    @property
    def rows(self) -> tuple[ExposureRow, ...]:
        """All exposures without their pixels, in order of time."""

    @property
    def arm(self) -> ArmTrack | None:
        """What the arm reported; None where no arm took part."""

    @property
    def is_simulated(self) -> bool:
        """True if the images were rendered."""

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]`` with its pixels."""


TwinScene = Literal[
    "camera",
    "laser",
    "hand-eye",
    "plate",
    "ball",
    "steps",
    "still-step",
    "part",
    "waves",
    "markers",
    "markers-moved",
    "probing",
    "still-part",
    "workpiece",
    "latency",
]
Preset = Literal["clean", "thesis", "harsh"]


class TwinTruth(Protocol):
    """What the twin was made from; asked for after a measurement, to state its errors."""

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy`` in px and ``k1 k2 p1 p2 k3``, of the left camera or the only one."""

    @property
    def right_camera_parameters(self) -> FloatArray | None:
        """(9,) the same of the right camera; None for a head of one camera."""

    @property
    def right_from_sensor(self) -> Pose[CameraRight, Sensor] | None:
        """Where the left camera is in the right one's frame; None for a head of one camera."""

    @property
    def sheet_points_mm(self) -> Mapping[str, FloatArray]:
        """(N, 3) true points of each light sheet over the working region, Sensor frame."""

    @property
    def tool_from_sensor(self) -> Pose[Tool, Sensor]:
        """The true hand-eye."""

    @property
    def plate_plane(self) -> FloatArray:
        """(4,) unit normal and D of the best plane through the true plate, in Base (eq. 2.55)."""

    @property
    def ball_diameter_mm(self) -> float:
        """Of the reference ball."""

    @property
    def step_heights_mm(self) -> tuple[float, ...]:
        """Heights of the gauge blocks over the face that they stand on."""

    @property
    def marker_centres_base_mm(self) -> FloatArray:
        """(N, 3) middles of all ring markers of the scene ``markers``."""

    @property
    def moved_from_base(self) -> Pose[Base, Base]:
        """From Base to the Base of the scene ``markers-moved``."""

    def part_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) in Base from the free-form part's surface."""

    def part_normals(self, points_base_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of that surface next to points (N, 3)."""

    @property
    def base_from_workpiece(self) -> Pose[Base, Part]:
        """Where the workpiece, or the part in its place, stands."""

    def workpiece_distance_mm(self, points_base_mm: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 3) in Base from its surface as it was made."""

    def document(self, scene: TwinScene | None = None) -> bytes:
        """All of it as JSON, with the mark ``"simulated": true``; of a scene also what it adds."""


class TrueStripe(Protocol):
    """Where one light sheet's centre truly lies in an image."""

    @property
    def sheet(self) -> str:
        """Name of the light sheet."""

    @property
    def points_px(self) -> FloatArray:
        """(N, 2) full-sensor pixels, about one a row or column of the image."""

    @property
    def points_base_mm(self) -> FloatArray:
        """(N, 3) the same points in Base."""


class SimulatedScan(ScanSource, Protocol):
    """A scan whose truth can be asked for, and whose lasers can be chosen while it is taken."""

    def true_stripes(self, row: int) -> Sequence[TrueStripe]:
        """The stripes of all lasers of the head in the exposure of a row, on or off."""

    def true_pose(self, row: int) -> Pose[Base, Sensor]:
        """Where the head truly is in the middle of an exposure."""

    def expose(self, row: int, lasers: tuple[str, ...]) -> Exposure:
        """The exposure of a row with other lasers on than its row says, as a live rig takes it."""


class Probing(Protocol):
    """The plate touched with a real tip, as the arm reports it."""

    @property
    def arm(self) -> ArmTrack:
        """One sample a touch."""

    @property
    def tool_from_probe_mm(self) -> FloatArray:
        """(3,) calibrated centre of the tip in Tool."""

    @property
    def tip_diameter_mm(self) -> float:
        """Calibrated diameter of the tip."""


class Twin(Protocol):
    """One simulated instrument: head, arm and what stands around it, drawn from one seed."""

    @property
    def head(self) -> str:
        """Name of the head, for example ``thesis-single``."""

    @property
    def preset(self) -> Preset:
        """How good the instrument and how kind the surroundings are."""

    @property
    def seed(self) -> int:
        """Everything random follows from it."""

    @property
    def target(self) -> str:
        """The calibration target as the command line names it."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the laser sources, each switched by itself."""

    @property
    def truth(self) -> TwinTruth:
        """What it was made from."""

    def scan(self, scene: TwinScene) -> SimulatedScan:
        """The recording of one scene; pixels are rendered when an exposure is asked for.

        ``camera`` and ``laser`` have no arm. In ``laser`` each view is one placement of the
        target: one exposure for each laser source alone, then one without any. In ``hand-eye``
        equal views are one posture. ``still-step`` is one exposure of a step: 20 mm, or 5 mm for
        a head of many lines. A head of two cameras takes every exposure with both at one instant:
        two rows of equal time, trigger and view. A head with several sources has all of them on
        during scans; `SimulatedScan.expose` takes an exposure with others. ``markers`` shows a
        part with ring markers from places named as views, each in the light of the room and then
        with the lasers; in ``markers-moved`` the part is still there, but the arm stands in
        another place, and so does Base. ``workpiece`` is the part of the CAD model that comes with
        the simulator, made with two faults, or another part in its place.
        ``latency`` is the plate with a reversing stand-off, found by time alone: the arm's times
        are later by a latency, which `TwinTruth.document` tells.
        """

    def probe_plate(self) -> Probing:
        """Touch the plate of the scene ``hand-eye``."""


GROUP = "armscan.drivers"


def driver_names() -> tuple[str, ...]:
    """Names of all installed drivers, sorted."""
    return tuple(sorted(entry_points(group=GROUP).names))


def load_driver(name: str) -> Any:
    """Return the object that the driver ``name`` registers.

    Raises
    ------
    OptionError
        If no installed package registers that name.
    """
    found = entry_points(group=GROUP, name=name)
    if not found:
        raise OptionError(
            f"no driver is called '{name}'",
            remedy=f"choose one of: {', '.join(driver_names()) or 'none is installed'}",
        )
    return next(iter(found)).load()
