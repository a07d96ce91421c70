# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_side import ProbeSide
from armscan.calibration.hand_eye.sphere_options import SphereOptions
from armscan.errors import OptionError
from armscan.geometry.euler import EulerConvention
from armscan.vision.stripe.options import StripeOptions


@dataclass(frozen=True, slots=True)
class HandEyeRequest:
    """What to calibrate a hand-eye from, and where to write.

    Either recordings with a sensor's calibration, or profiles of a sensor that delivers points
    with a table of poses; of a plate or of a sphere.

    Parameters
    ----------
    scans
        Folders of recordings; several are one calibration each, and one of all together.
    sensor
        The sensor's calibration ``sensor.json``; None with profiles.
    profiles
        Profiles of points: files, folders or patterns, one a posture.
    poses
        Table of the robot's poses, one a profile, in the profiles' order.
    euler
        What the angles in ``poses`` mean.
    plate
        Probed points of the plate, or a file with its ``A,B,C,D``.
    plane
        ``A,B,C,D`` of the plate in Base; empty for none.
    side
        Axis of Base along which the plate's face looks; None to take it from where the arm was.
    sphere_diameter_mm
        Diameter of the sphere in place of a plate; None for a plate.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    output
        The document ``NAME.json``; ``NAME.html`` is written beside it.
    options, sphere_options
        Of the plate and of the sphere method.
    stripes
        Of stripe extraction.
    is_overwriting
        Replace results that exist.
    command
        The command line, for the record.

    Raises
    ------
    OptionError
        If these do not go together.
    """

    output: Path
    scans: tuple[Path, ...] = ()
    sensor: Path | None = None
    profiles: tuple[str, ...] = ()
    poses: Path | None = None
    euler: EulerConvention = "extrinsic-xyz"
    plate: Path | None = None
    plane: str = ""
    side: ProbeSide | None = None
    sphere_diameter_mm: float | None = None
    arm: Path | None = None
    options: HandEyeOptions = field(default_factory=HandEyeOptions)
    sphere_options: SphereOptions = field(default_factory=SphereOptions)
    stripes: StripeOptions = field(default_factory=StripeOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_source(self)
        _check_reference(self)

    @property
    def is_sphere(self) -> bool:
        """True if a sphere was looked at, False for a plate."""
        return self.sphere_diameter_mm is not None


def _check_source(request: HandEyeRequest) -> None:
    has_profiles = bool(request.profiles) or request.poses is not None
    if bool(request.scans) == has_profiles:
        raise OptionError(
            "recordings and profiles do not mix" if has_profiles else "nothing to calibrate from",
            remedy="name a recording's folder, or give --profiles with --poses",
        )
    if has_profiles and (not request.profiles or request.poses is None):
        raise OptionError(
            "profiles and poses belong together", remedy="give --profiles and --poses"
        )
    if request.scans and request.sensor is None:
        raise OptionError(
            "a recording of images needs the sensor's calibration",
            remedy="give --sensor sensor.json, as `armscan calibrate laser` writes it",
        )


def _check_reference(request: HandEyeRequest) -> None:
    given = [request.plate is not None, bool(request.plane), request.is_sphere]
    if sum(given) != 1:
        raise OptionError(
            "the reference is not given" if not any(given) else "there is more than one reference",
            remedy="give one of --plate plate.csv, --plane A,B,C,D, --sphere-diameter MM; with "
            "--solve-plate a rough plane is enough",
        )
    if request.is_sphere and request.options.solve_plate:
        raise OptionError("a sphere has no plate to solve", remedy="leave --solve-plate out")
