# SPDX-License-Identifier: Apache-2.0
"""Profiles that a sensor delivered, as what a hand-eye calibration observes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_sphere
from armscan.calibration.hand_eye.observations import HandEyeOptions, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.shapes import fit_plane
from armscan.records.profile import PointProfile

MAD_TO_SIGMA = 1.4826
THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])
"""Blind to any parabola, so to the course of a profile over four points."""
REPEATED_DEG = 0.1
REPEATED_MM = 0.1


def posed_stripes_from_profiles(
    profiles: Sequence[PointProfile], poses: Sequence[Pose[Base, Tool]]
) -> tuple[PosedStripe, ...]:
    """Join profiles and poses of equal order; the noise of the points is their own scatter.

    The noise is taken from the third differences of neighbouring points, which neither a line nor
    a circle touches; it acts across the profile, within its plane.

    Parameters
    ----------
    profiles
        One an exposure, in the Sensor frame.
    poses
        ``base_from_tool`` of each.

    Raises
    ------
    InputError
        If the counts differ.
    """
    if len(profiles) != len(poses):
        raise InputError(
            f"{len(profiles)} profiles but {len(poses)} poses",
            remedy="give one pose for each profile, in the same order",
        )
    postures = _postures(profiles, poses)
    return tuple(
        PosedStripe(
            source=profile.source,
            posture=posture,
            base_from_tool=pose,
            points_mm=profile.points_mm,
            noise_mm=_noise(profile.points_mm)[:, :, None],
            sheet=np.zeros(len(profile), dtype=np.int64),
        )
        for profile, posture, pose in zip(profiles, postures, poses, strict=True)
    )


def calibrate_hand_eye_from_profiles(
    profiles: Sequence[PointProfile],
    poses: Sequence[Pose[Base, Tool]],
    diameter_mm: float,
    options: HandEyeOptions | None = None,
) -> HandEyeFit | FitFailure:
    """Hand-eye from profiles of a sphere.

    Parameters
    ----------
    profiles, poses
        As for `posed_stripes_from_profiles`.
    diameter_mm
        Of the sphere.
    options
        Of `calibrate_on_sphere`.
    """
    stripes = posed_stripes_from_profiles(profiles, poses)
    return calibrate_on_sphere(stripes, diameter_mm, options)


def _postures(profiles: Sequence[PointProfile], poses: Sequence[Pose[Base, Tool]]) -> list[str]:
    """Profiles of one pose bear the name of the first of them."""
    names: list[str] = []
    for k, pose in enumerate(poses):
        same = [
            j
            for j in range(k)
            if np.linalg.norm(poses[j].translation_mm - pose.translation_mm) < REPEATED_MM
            and np.abs(poses[j].rotation - pose.rotation).max() < np.radians(REPEATED_DEG)
        ]
        names.append(names[same[0]] if same else profiles[k].source)
    return names


def _noise(points_mm: FloatArray) -> FloatArray:
    """(N, 3) noise across the profile, in its plane, as a vector."""
    n = len(points_mm)
    plane = fit_plane(points_mm)
    if n < 8 or isinstance(plane, FitFailure):
        return np.zeros((n, 3))
    tangent = np.gradient(points_mm, axis=0)
    length = np.linalg.norm(tangent, axis=1)
    across = np.cross(plane.value.normal, tangent / np.maximum(length, 1e-12)[:, None])
    rough = np.apply_along_axis(np.convolve, 0, points_mm, THIRD_DIFFERENCE, "valid")
    own = np.abs(np.einsum("ni,ni->n", rough, across[1:-2])) / np.linalg.norm(THIRD_DIFFERENCE)
    return np.asarray(across * MAD_TO_SIGMA * float(np.median(own)))
