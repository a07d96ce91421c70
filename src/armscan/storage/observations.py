# SPDX-License-Identifier: Apache-2.0
"""What a calibration saw, in one ``.npz``: enough to solve again and to draw, without pixels."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.records.profile import Profile
from armscan.storage.files import read_bytes
from armscan.vision.targets.target import TargetView

VIEW_ARRAYS = ("point_index", "points_px", "covariance_px2", "points_board_mm")
VIEW_SCALARS = ("source", "width_px", "height_px", "is_ambiguous")
PROFILE_ARRAYS = (
    "points_px",
    "normals_px",
    "sigma_px",
    "width_px",
    "intensity",
    "flags",
    "segment",
)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Target views, and the stripes seen with them.

    Parameters
    ----------
    views
        Target points of each image, without the edge points of circles.
    profiles
        Stripe points, one profile a view where there are any.
    sha256
        Hash of the image of each source name.
    """

    views: tuple[TargetView, ...]
    profiles: tuple[Profile, ...]
    sha256: Mapping[str, str]


def pack_observations(
    views: Sequence[TargetView], profiles: Sequence[Profile], sha256: Mapping[str, str]
) -> bytes:
    """Content of the ``.npz`` file; see `Observations`."""
    arrays: dict[str, NDArray[Any]] = {
        "image_source": np.array(list(sha256), dtype=np.str_),
        "image_sha256": np.array(list(sha256.values()), dtype=np.str_),
    }
    for name in VIEW_SCALARS:
        arrays[f"view_{name}"] = np.array([getattr(view, name) for view in views])
    arrays["view_n_points"] = np.array([len(view) for view in views], dtype=np.int64)
    for name in VIEW_ARRAYS if views else ():
        arrays[f"view_{name}"] = np.concatenate([getattr(view, name) for view in views])
    arrays["profile_source"] = np.array([profile.source for profile in profiles], dtype=np.str_)
    arrays["profile_n_points"] = np.array([len(profile) for profile in profiles], dtype=np.int64)
    for name in PROFILE_ARRAYS if profiles else ():
        arrays[f"profile_{name}"] = np.concatenate([getattr(item, name) for item in profiles])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def read_observations(path: Path) -> Observations:
    """Read what `pack_observations` wrote.

    Raises
    ------
    FileFormatError
        If the file is cut short or is no such file.
    """
    data = read_bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return Observations(
            views=_views(arrays),
            profiles=_profiles(arrays),
            sha256=dict(
                zip(arrays["image_source"].tolist(), arrays["image_sha256"].tolist(), strict=True)
            ),
        )
    except (zipfile.BadZipFile, ValueError, KeyError, EOFError, OSError) as error:
        raise FileFormatError(
            "this is not a complete file of observations",
            where=str(path),
            remedy="copy the file again, or calibrate again",
        ) from error


def _pieces(arrays: Mapping[str, NDArray[Any]], prefix: str, name: str) -> list[NDArray[Any]]:
    ends = np.cumsum(arrays[f"{prefix}_n_points"])
    return np.split(arrays[f"{prefix}_{name}"], ends[:-1]) if len(ends) else []


def _views(arrays: Mapping[str, NDArray[Any]]) -> tuple[TargetView, ...]:
    n = len(arrays["view_n_points"])
    pieces = {name: _pieces(arrays, "view", name) for name in VIEW_ARRAYS if n}
    return tuple(
        TargetView(
            source=str(arrays["view_source"][k]),
            width_px=int(arrays["view_width_px"][k]),
            height_px=int(arrays["view_height_px"][k]),
            is_ambiguous=bool(arrays["view_is_ambiguous"][k]),
            point_index=pieces["point_index"][k],
            points_px=pieces["points_px"][k],
            covariance_px2=pieces["covariance_px2"][k],
            points_board_mm=pieces["points_board_mm"][k],
        )
        for k in range(n)
    )


def _profiles(arrays: Mapping[str, NDArray[Any]]) -> tuple[Profile, ...]:
    n = len(arrays["profile_n_points"])
    pieces = {name: _pieces(arrays, "profile", name) for name in PROFILE_ARRAYS if n}
    return tuple(
        Profile(
            source=str(arrays["profile_source"][k]),
            **{name: pieces[name][k] for name in PROFILE_ARRAYS},
        )
        for k in range(n)
    )
