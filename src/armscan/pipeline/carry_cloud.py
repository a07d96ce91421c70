# SPDX-License-Identifier: Apache-2.0
"""A cloud carried to another frame, with what the registration adds to its uncertainty."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.registration import carried_covariance_mm2
from armscan.records.cloud import CloudFrame, PointCloud


def carry_cloud(
    cloud: PointCloud, a_from_b: Pose[Any, Any], covariance: FloatArray, frame: CloudFrame
) -> PointCloud:
    """Carry a cloud to the frame ``A``.

    Parameters
    ----------
    cloud
        Points in ``B``.
    a_from_b
        The registration.
    covariance
        (6, 6) of `armscan.geometry.registration.REGISTRATION_PARAMETERS`.
    frame
        Name of ``A``.

    Returns
    -------
    PointCloud
        Points' covariances are turned and get the registration's part, which is common to all
        points; a cloud of another program, with none, keeps none. ``sigma_noise_mm``, the part
        that is independent from point to point, stays.
    """
    points = cloud.points_mm @ a_from_b.rotation.T + a_from_b.translation_mm
    own = cloud.covariance_mm2
    is_known = bool(np.any(own))
    return replace(
        cloud,
        frame=frame,
        points_mm=points,
        covariance_mm2=(
            carried_covariance_mm2(cloud.points_mm, own, a_from_b, covariance) if is_known else own
        ),
        normals=None if cloud.normals is None else cloud.normals @ a_from_b.rotation.T,
    )
