# SPDX-License-Identifier: Apache-2.0
"""Several clouds in one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.errors import InputError
from armscan.records.cloud import PointCloud


def merge_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Join clouds of one frame and one list of sheets, in the order given.

    The exposures of each cloud follow those of the one before; clouds with and without normals do
    not mix.

    Raises
    ------
    InputError
        If there is no cloud, or if frames, sheets or the presence of normals differ.
    """
    if not clouds:
        raise InputError("no clouds to merge")
    first = clouds[0]
    for cloud in clouds[1:]:
        if cloud.frame != first.frame or cloud.sheet_names != first.sheet_names:
            raise InputError(
                f"clouds in frames {first.frame} and {cloud.frame} with sheets "
                f"{', '.join(first.sheet_names)} and {', '.join(cloud.sheet_names)} do not merge"
            )
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    if normals and len(normals) != len(clouds):
        raise InputError("clouds with and without normals do not merge")
    starts = np.cumsum([0, *(len(cloud.exposure_sources) for cloud in clouds)])
    return PointCloud(
        first.frame,
        np.concatenate([cloud.points_mm for cloud in clouds]),
        np.concatenate([cloud.covariance_mm2 for cloud in clouds]),
        np.concatenate([cloud.sigma_noise_mm for cloud in clouds]),
        np.concatenate([cloud.sheet for cloud in clouds]),
        first.sheet_names,
        np.concatenate([c.exposure + start for c, start in zip(clouds, starts[:-1], strict=True)]),
        tuple(source for cloud in clouds for source in cloud.exposure_sources),
        np.concatenate([cloud.segment for cloud in clouds]),
        np.concatenate([cloud.intensity for cloud in clouds]),
        np.concatenate(normals) if normals else None,
    )
