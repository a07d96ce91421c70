# SPDX-License-Identifier: Apache-2.0
"""What a calibration saw, in one ``.npz``: enough to solve again and to draw, without pixels."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.calibration.sheets.result import LaserFit, PlacedBoard, PointUse
from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import BoolArray
from armscan.geometry.poses import Pose
from armscan.records.profile import Profile, StripeFlag
from armscan.storage.files import read_bytes
from armscan.vision.targets.target import TargetView

VIEW_ARRAYS = ("point_index", "points_px", "covariance_px2", "points_board_mm")
VIEW_SCALARS = ("source", "width_px", "height_px", "is_ambiguous")
LASERS_APART = "\n"
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
class StripeContext:
    """What belongs to a stripe image on a board besides its points.

    Parameters
    ----------
    lasers
        Names of the sources that were on.
    camera
        0, or 1 for the right camera of a stereo head.
    placement
        Images of equal placement saw the board in one place.
    on_edge
        (N,) points along an edge of the target's marks; None if the edges are not known.
    has_rims
        True for a target of circles whose rims were seen.
    placed
        The board's pose in Sensor.
    """

    lasers: tuple[str, ...]
    camera: int
    placement: str
    on_edge: BoolArray | None
    has_rims: bool
    placed: PlacedBoard


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
    contexts
        One entry a profile; empty in files of versions before they were kept.
    """

    views: tuple[TargetView, ...]
    profiles: tuple[Profile, ...]
    sha256: Mapping[str, str]
    contexts: tuple[StripeContext, ...] = ()


def pack_observations(
    views: Sequence[TargetView],
    profiles: Sequence[Profile],
    sha256: Mapping[str, str],
) -> bytes:
    """Content of the ``.npz`` file; see `Observations`."""
    return _packed(_arrays(views, profiles, sha256))


def pack_board_stripes(fit: LaserFit, sha256: Mapping[str, str]) -> bytes:
    """Content of the ``.npz`` file of light sheets: all that their calibration was given.

    Points that lie along an edge of the target and are not used for that are flagged.

    Raises
    ------
    InputError
        If the pose of a board in Sensor was not given.
    """
    boards, profiles, placed, on_edge = fit.boards, [], [], []
    for board, image in zip(boards, fit.images, strict=True):
        is_on_edge = image.use == int(PointUse.ON_EDGE)
        flags = board.profile.flags | np.where(is_on_edge, int(StripeFlag.TARGET_EDGE), 0)
        profiles.append(replace(board.profile, flags=flags))
        known = np.zeros(len(board.profile), dtype=np.bool_)
        on_edge.append(known if board.on_edge is None else board.on_edge)
        if board.placed is None:
            raise InputError(f"{board.view.source}: the board's pose in Sensor is not given")
        placed.append(board.placed)
    lasers = [LASERS_APART.join(board.lasers) for board in boards]
    return _packed(
        _arrays([board.view for board in boards], profiles, sha256)
        | {
            "board_lasers": np.array(lasers, dtype=np.str_),
            "board_camera": np.array([board.camera for board in boards]),
            "board_placement": np.array([board.placement for board in boards], dtype=np.str_),
            "profile_on_edge": np.concatenate(on_edge),
            "board_has_edges": np.array([board.on_edge is not None for board in boards]),
            "board_has_rims": np.array([board.view.edges is not None for board in boards]),
            "board_rotation": np.stack([one.sensor_from_board.rotation for one in placed]),
            "board_translation_mm": np.stack(
                [one.sensor_from_board.translation_mm for one in placed]
            ),
            "board_covariance": np.stack([one.covariance for one in placed]),
            "board_by_cameras": np.stack([one.by_cameras for one in placed]),
        }
    )


def _arrays(
    views: Sequence[TargetView], profiles: Sequence[Profile], sha256: Mapping[str, str]
) -> dict[str, NDArray[Any]]:
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
    return arrays


def _packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
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
            contexts=_contexts(arrays) if "board_camera" in arrays else (),
            sha256=dict(
                zip(arrays["image_source"].tolist(), arrays["image_sha256"].tolist(), strict=True)
            ),
        )
    except (zipfile.BadZipFile, ValueError, KeyError, IndexError, EOFError, OSError) as error:
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


def _contexts(arrays: Mapping[str, NDArray[Any]]) -> tuple[StripeContext, ...]:
    on_edge = _pieces(arrays, "profile", "on_edge")
    return tuple(
        StripeContext(
            lasers=tuple(filter(None, str(arrays["board_lasers"][k]).split(LASERS_APART))),
            camera=int(arrays["board_camera"][k]),
            placement=str(arrays["board_placement"][k]),
            on_edge=on_edge[k] if arrays["board_has_edges"][k] else None,
            has_rims=bool(arrays["board_has_rims"][k]),
            placed=PlacedBoard(
                Pose(arrays["board_rotation"][k], arrays["board_translation_mm"][k]),
                arrays["board_covariance"][k],
                arrays["board_by_cameras"][k],
            ),
        )
        for k in range(len(on_edge))
    )
