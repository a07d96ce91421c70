# SPDX-License-Identifier: Apache-2.0
"""Points of a scan on disk while it grows, so that memory does not grow with it.

Columns lie in files of their own: what looks at places alone reads 24 bytes a point. Points of one
exposure are consecutive; a piece, which is all that is read at a time, holds whole instants.
"""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError, OutputError
from armscan.geometry.arrays import FloatArray, IntArray, extents
from armscan.records.cloud import CalibrationErrors, CloudFrame, PointCloud

PIECE_POINTS = 50_000
"""Points of a piece, unless one instant has more: some 12 MB with all that is made of them."""
COLUMNS, NORMALS = ("places", "sigmas", "rest"), "normals"
PLACE = np.dtype((np.float64, 3))
SIGMAS = np.dtype((np.float64, 2))
REST = np.dtype(
    [
        ("covariance_mm2", "<f8", (3, 3)),
        ("noise_length", "<f8"),
        ("intensity", "<f8"),
        ("pixel_px", "<f8", (2,)),
        ("sheet", "<i4"),
        ("segment", "<i4"),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class SpoolPiece:
    """Consecutive points of a spool.

    Parameters
    ----------
    start
        Count of points before them.
    cloud
        The points; ``exposure`` counts all exposures that the spool keeps.
    sigma_mm
        (N,) as `PointCloud.sigma_mm`, computed once.
    pixel_px
        (N, 2) where each was seen; zero where not told.
    """

    start: int
    cloud: PointCloud
    sigma_mm: FloatArray
    pixel_px: FloatArray


@dataclass(slots=True, eq=False)
class PointSpool:
    """Points of exposures in one frame, appended one exposure after another.

    ``folder`` is that of its files, which are its own; None keeps everything in memory.
    """

    frame: CloudFrame
    sheet_names: tuple[str, ...]
    folder: Path | None = None
    _places: BinaryIO = field(init=False)
    _sigmas: BinaryIO = field(init=False)
    _rest: BinaryIO = field(init=False)
    _sources: list[str] = field(default_factory=list)
    _ends: array[int] = field(default_factory=lambda: array("q", [0]))
    _instants: array[int] = field(default_factory=lambda: array("q"))
    _corners: array[float] = field(default_factory=lambda: array("d"))
    _kept: IntArray | None = None
    _normals: BinaryIO | None = None
    _has_noise_length: bool | None = None
    _seen_from_mm: FloatArray | None = None
    _calibration_errors: CalibrationErrors | None = None

    def __post_init__(self) -> None:
        self._places, self._sigmas, self._rest = map(self._opened, COLUMNS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Delete the files."""
        for file in (self._places, self._sigmas, self._rest, self._normals):
            with suppress(OSError):
                if file is not None:
                    file.close()
        if self.folder is not None:
            for name in (*COLUMNS, NORMALS):
                (self.folder / name).unlink(missing_ok=True)

    def __len__(self) -> int:
        """Count of points kept."""
        return int(self._counts().sum())

    @property
    def n_exposures(self) -> int:
        """Exposures appended, kept or not."""
        return len(self._sources)

    @property
    def kept(self) -> IntArray:
        """(E,) numbers of the exposures kept, as they were appended."""
        return np.arange(len(self._sources)) if self._kept is None else self._kept

    @property
    def corners_mm(self) -> FloatArray:
        """(2, 3) lowest and highest coordinates of the points kept."""
        found = np.array(self._corners).reshape(-1, 2, 3)[self.kept[self._counts() > 0]]
        return np.stack([found[:, 0].min(axis=0), found[:, 1].max(axis=0)])

    def count(self, exposure: int) -> int:
        """Points of one exposure, numbered as appended."""
        return self._ends[exposure + 1] - self._ends[exposure]

    def add(
        self, cloud: PointCloud, pixel_px: FloatArray | None = None, *, instant: int | None = None
    ) -> None:
        """Append the points of one exposure.

        Parameters
        ----------
        cloud
            Of one exposure, in this frame, with these sheets; normals are left out.
        pixel_px
            (N, 2) where they were seen; None where nobody asks.
        instant
            Exposures that follow each other with one number stay in one piece; None for an instant
            of its own.

        Raises
        ------
        InputError
            If the cloud is of another kind, or the correlation of noise is known of some points
            only.
        OutputError
            If the disk is full or refuses.
        """
        if (cloud.frame, cloud.sheet_names) != (self.frame, self.sheet_names):
            raise InputError("clouds of other frames or sheets do not join")
        has_length = cloud.noise_length is not None
        if len(cloud) and self._has_noise_length is None:
            self._has_noise_length = has_length
        if len(cloud) and has_length != self._has_noise_length:
            raise InputError("noise_length differs between the clouds to join")
        rest = np.zeros(len(cloud), dtype=REST)
        rest["covariance_mm2"], rest["intensity"] = cloud.covariance_mm2, cloud.intensity
        rest["sheet"], rest["segment"] = cloud.sheet, cloud.segment
        if cloud.noise_length is not None:
            rest["noise_length"] = cloud.noise_length
        if pixel_px is not None:
            rest["pixel_px"] = pixel_px
        sigmas = np.stack([cloud.sigma_mm, cloud.sigma_noise_mm], axis=1)
        self._append(self._places, cloud.points_mm)
        self._append(self._sigmas, sigmas)
        self._append(self._rest, rest)
        n = len(self._sources)
        self._sources.append(cloud.exposure_sources[0])
        self._ends.append(self._ends[-1] + len(cloud))
        self._instants.append(-1 - n if instant is None else instant)
        corners = extents(cloud.points_mm if len(cloud) else np.zeros((1, 3)))
        self._corners.extend(corners.ravel())

    def keep(self, exposures: Sequence[int]) -> None:
        """Leave out all other exposures from now on; rising numbers, as appended."""
        self._kept = np.array(exposures, dtype=np.int64)

    def look_from(self, seen_from_mm: FloatArray, errors: CalibrationErrors | None = None) -> None:
        """Say where the sensor stood, (E, 3), at the exposures kept, in their order, and what its
        calibration may err by.
        """
        self._seen_from_mm, self._calibration_errors = seen_from_mm, errors

    def add_normals(self, normals: FloatArray) -> None:
        """Append normals (N, 3) of the next points kept, in the order of `places`.

        Raises
        ------
        OutputError
            If the disk is full or refuses.
        """
        self._normals = self._normals or self._opened(NORMALS)
        self._append(self._normals, normals)

    def without_points(self) -> PointCloud:
        """The cloud's names and marks, and none of its points."""
        empty = PointCloud.empty(
            frame=self.frame,
            sheet_names=self.sheet_names,
            exposure_sources=tuple(self._sources[k] for k in self.kept),
        )
        return replace(
            empty,
            noise_length=np.zeros(0) if self._has_noise_length else None,
            normals=None if self._normals is None else np.zeros((0, 3)),
            seen_from_mm=self._seen_from_mm,
            calibration_errors=self._calibration_errors,
        )

    def of_exposure(self, exposure: int) -> PointCloud:
        """All points of one exposure, numbered as appended."""
        # not of `without_points`, which names all exposures
        names = PointCloud.empty(
            frame=self.frame,
            sheet_names=self.sheet_names,
            exposure_sources=(self._sources[exposure],),
        )
        owners = np.zeros(self.count(exposure), dtype=np.int64)
        return self._piece(0, np.array([exposure]), owners, names).cloud

    def places(self) -> Iterator[tuple[FloatArray, IntArray]]:
        """Points (N, 3) and numbers (N,) of their exposures among those kept, piece by piece."""
        for first, exposures in self._groups():
            yield self._read(self._places, PLACE, exposures), self._owners(first, exposures)

    def sigmas(self) -> Iterator[FloatArray]:
        """(N, 2) standard deviation in mm of each point, and that of its noise, piece by piece."""
        for _, exposures in self._groups():
            yield self._read(self._sigmas, SIGMAS, exposures)

    def rest(self) -> Iterator[NDArray[Any]]:
        """(N,) of `REST`: all else that is kept of the points, as it was given, piece by piece."""
        for _, exposures in self._groups():
            yield self._read(self._rest, REST, exposures)

    def pieces(self) -> Iterator[SpoolPiece]:
        """All that is kept, piece by piece."""
        names, start = self.without_points(), 0
        for first, exposures in self._groups():
            owners = self._owners(first, exposures)
            yield self._piece(start, exposures, owners, names)
            start += len(owners)

    def cloud(self) -> PointCloud:
        """Everything at once, for a scan that fits into memory."""
        parts = [piece.cloud for piece in self.pieces()] or [self.without_points()]
        return PointCloud.concat(parts)

    def _opened(self, name: str) -> BinaryIO:
        return io.BytesIO() if self.folder is None else (self.folder / name).open("w+b")

    def _append(self, file: BinaryIO, values: NDArray[Any]) -> None:
        try:
            file.seek(0, io.SEEK_END)
            file.write(np.ascontiguousarray(values).data)
            # a full disk is told here, not where the points are read
            file.flush()
        except OSError as error:
            raise OutputError(
                f"the growing cloud cannot be kept ({error.strerror})",
                where=str(self.folder),
                remedy="free some space: a growing cloud takes 180 bytes a point",
            ) from error

    def _counts(self) -> IntArray:
        ends = np.array(self._ends, dtype=np.int64)
        return np.asarray((ends[1:] - ends[:-1])[self.kept])

    def _groups(self) -> Iterator[tuple[int, IntArray]]:
        """Place of the first among those kept, and numbers as appended, of each piece."""
        kept, counts = self.kept, self._counts()
        instants = np.array(self._instants, dtype=np.int64)[kept]
        first = held = 0
        for k in range(len(kept)):
            is_new = k > first and instants[k] != instants[k - 1]
            if is_new and held + int(counts[k]) > PIECE_POINTS:
                yield first, kept[first:k]
                first, held = k, 0
            held += int(counts[k])
        if len(kept):
            yield first, kept[first:]

    def _owners(self, first: int, exposures: IntArray) -> IntArray:
        counts = [self.count(int(k)) for k in exposures]
        return np.repeat(np.arange(first, first + len(exposures)), counts)

    def _read(self, file: BinaryIO, kind: np.dtype[Any], exposures: IntArray) -> NDArray[Any]:
        """Rows of exposures of rising number; consecutive ones in one go."""
        breaks = np.flatnonzero(np.diff(exposures) != 1) + 1
        parts = []
        for run in np.split(exposures, breaks):
            begin, end = self._ends[int(run[0])], self._ends[int(run[-1]) + 1]
            file.seek(begin * kind.itemsize)
            parts.append(file.read((end - begin) * kind.itemsize))
        return np.frombuffer(b"".join(parts), kind)

    def _piece(
        self, start: int, exposures: IntArray, owners: IntArray, names: PointCloud
    ) -> SpoolPiece:
        rest = self._read(self._rest, REST, exposures)
        sigmas = self._read(self._sigmas, SIGMAS, exposures)
        normals = None
        if names.normals is not None and self._normals is not None:
            self._normals.seek(PLACE.itemsize * start)
            found = np.frombuffer(self._normals.read(PLACE.itemsize * len(owners)))
            normals = found.reshape(-1, 3)
        cloud = PointCloud(
            frame=self.frame,
            points_mm=self._read(self._places, PLACE, exposures),
            covariance_mm2=rest["covariance_mm2"],
            sigma_noise_mm=sigmas[:, 1],
            sheet=rest["sheet"],
            sheet_names=self.sheet_names,
            exposure=owners,
            exposure_sources=names.exposure_sources,
            segment=rest["segment"],
            intensity=rest["intensity"],
            normals=normals,
            noise_length=rest["noise_length"] if self._has_noise_length else None,
            seen_from_mm=names.seen_from_mm,
            calibration_errors=names.calibration_errors,
        )
        return SpoolPiece(start, cloud, sigmas[:, 0], np.asarray(rest["pixel_px"]))
