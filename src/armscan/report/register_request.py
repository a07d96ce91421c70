# SPDX-License-Identifier: Apache-2.0
"""What to join, where to write it, and which cloud belongs to which list of markers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from armscan.errors import InputError, OptionError
from armscan.pipeline.register import RegisterOptions
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.foreign_clouds import FOREIGN_FRAME, read_cloud
from armscan.storage.marker_files import MarkerList, read_marker_list


@dataclass(frozen=True, slots=True)
class RegisterRequest:
    """What to join, and where to write.

    Parameters
    ----------
    lists
        Lists of markers: one for each view, or the old one of an arm that moved.
    moved
        List of the markers that the arm measured at its new place; None for views.
    clouds
        Clouds of the new place; empty to take those beside the lists.
    output
        New folder.
    options
        How to match.
    command
        The command line, for the record.
    """

    lists: tuple[Path, ...]
    output: Path
    moved: Path | None = None
    clouds: tuple[Path, ...] = ()
    options: RegisterOptions = field(default_factory=RegisterOptions)
    command: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NamedCloud:
    """A cloud and the name of its file in the new folder."""

    name: str
    path: Path
    cloud: PointCloud


def checked(request: RegisterRequest) -> RegisterRequest:
    """Return the request, or say what it lacks.

    Raises
    ------
    OptionError
        If the lists or the options do not go together.
    """
    if request.moved is None:
        if len(request.lists) < 2:
            raise OptionError(
                "one list of markers cannot be joined to anything",
                where=str(request.lists[0]) if request.lists else "",
                remedy="name two views or more, or give --moved NEW for an arm that moved",
            )
        for is_given, option in (
            (bool(request.clouds), "--cloud"),
            (request.options.is_by_id, "--by-id"),
        ):
            if is_given:
                raise OptionError("it needs --moved", where=option, remedy="leave it out")
    elif len(request.lists) != 1:
        raise OptionError(
            f"{len(request.lists)} lists for one old place",
            where="--moved",
            remedy="give one list of the old place and one of the new",
        )
    paths = [*request.lists, *(() if request.moved is None else (request.moved,))]
    twice = [path for path, n in Counter(path.resolve() for path in paths).items() if n > 1]
    if twice:
        raise OptionError("the list is given twice", where=str(twice[0]), remedy="name it once")
    return request


def read_lists(paths: Sequence[Path], frame: str, options: RegisterOptions) -> list[MarkerList]:
    """Read lists of markers; ``frame`` is that of lists which name none."""
    return [read_marker_list(path, frame=frame, sigma_mm=options.sigma_mm) for path in paths]


def cloud_beside(path: Path) -> Path | None:
    """The cloud ``NAME.ply`` beside the list ``NAME.csv``, if there is one."""
    beside = path.with_suffix(".ply")
    return beside if beside.is_file() else None


def read_named_cloud(path: Path, name: str, markers: MarkerList) -> NamedCloud:
    """Read the cloud of a list of markers.

    Raises
    ------
    InputError
        If the cloud is in another frame than the markers.
    """
    cloud = read_cloud(path)
    if cloud.frame not in (markers.markers.frame, FOREIGN_FRAME):
        raise InputError(
            f"the cloud is in {cloud.frame}, its markers are in {markers.markers.frame}",
            where=f"{path} and {markers.path}",
            remedy="measure both in one frame, or correct '# frame =' in the list",
        )
    return NamedCloud(f"{name}.ply", path, cloud)


def different_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A short name for each path: its stem, with the folder before it where stems repeat."""
    stems = Counter(path.stem for path in paths)
    names = [
        path.stem if stems[path.stem] == 1 else f"{path.resolve().parent.name}-{path.stem}"
        for path in paths
    ]
    repeated = {name for name, n in Counter(names).items() if n > 1}
    return tuple(f"{k + 1}-{name}" if name in repeated else name for k, name in enumerate(names))


def common_frame(markers: MarkerList) -> CloudFrame:
    """Frame of the result: Base stays Base; what a handheld sensor measured is on the part."""
    return "Base" if markers.markers.frame == "Base" else "Part"
