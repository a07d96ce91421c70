# SPDX-License-Identifier: Apache-2.0
"""Exposures that the cameras of a head took at one instant, and pairs with and without laser."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import cv2
import numpy as np
from scipy.ndimage import grey_opening

from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, InputError, begun
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.models.camera import CameraModel
from armscan.pipeline.progress import Progress, ProgressEvent, StageClock
from armscan.records.exposure import Exposure
from armscan.records.profile import PointProfile, Profile
from armscan.records.recording import LASER_UNKNOWN, ExposureRow

ExposurePair = tuple[Exposure, Exposure | None]
LISTED = 4
REDUCED_PX = 120
OTHER_VIEW = 0.15
LEAST_CONTRAST = 0.02
"""A pair shows two scenes if the correlation of their structure is below `OTHER_VIEW`, given that
both have a contrast of more than this part of full scale: a dark room shows no structure."""
THIN_BLOCKS = 5
"""A laser's line is narrower than so many blocks of the reduced image, wide or saturated as it may
be: a twentieth of the image's shorter side."""
THIN_SHARE = 0.001
SWAPPED_RATIO = 3.0
"""The pair is swapped if the partner's brightest `THIN_SHARE` of the pixels stands this many times
further above the image than the image's above the partner."""
ENOUGH_PX = 500_000
LARGEST_STEP_PX = 3
"""Of a larger image every second or third pixel of as many rows tells enough; at more a line that
lies along rows could fall between them."""
CLIPPED_SHARE = 0.99
SAME_VIEW = 0.3
MISORDERED = 0.6
"""An exposure is taken to belong to another partner if its own explains less than this part of what
that one does, and that one correlates by more than `SAME_VIEW`."""


def pair_exposures(
    exposures: Sequence[Exposure], backgrounds: Sequence[Exposure]
) -> list[ExposurePair]:
    """Pair exposures with backgrounds: by file name where the names agree, else by order.

    Parameters
    ----------
    exposures
        With the laser on.
    backgrounds
        The same views without laser; empty for none.

    Raises
    ------
    InputError
        If there is no exposure, if the counts differ, if a pair differs in size or window, or if
        an exposure plainly shows the view of another one's partner.
    """
    if not exposures:
        raise InputError("no images with the laser on", remedy="give at least one image")
    if not backgrounds:
        return [(exposure, None) for exposure in exposures]
    chosen = pair_sources([e.source for e in exposures], [b.source for b in backgrounds])
    return checked_pairs(exposures, [backgrounds[k] for k in chosen])


def checked_pairs(
    exposures: Sequence[Exposure], partners: Sequence[Exposure]
) -> list[ExposurePair]:
    """Exposures with the partners that they have, several perhaps the same one.

    Raises
    ------
    InputError
        As `pair_exposures`, of counts apart.
    """
    for exposure, partner in zip(exposures, partners, strict=True):
        _check_pair(exposure, partner)
    _check_order(exposures, partners)
    for exposure, partner in zip(exposures, partners, strict=True):
        check_partner(exposure, partner)
    return list(zip(exposures, partners, strict=True))


def pair_sources(lit: Sequence[str], dark: Sequence[str]) -> list[int]:
    """Place among the images without laser of the partner of each image with laser.

    By file name where the names agree, else by order.

    Raises
    ------
    InputError
        If the counts differ, or an image would get another partner than that of its own name.
    """
    if len(lit) != len(dark):
        raise InputError(
            f"{len(lit)} images with laser ({_listed(lit)}) but {len(dark)} without "
            f"({_listed(dark)})",
            remedy="give one image without laser for each image with laser, in the same order, "
            "or none at all",
        )
    names = [PurePath(source).name for source in lit]
    dark_names = [PurePath(source).name for source in dark]
    if len(set(dark_names)) == len(dark) and set(names) == set(dark_names):
        return [dark_names.index(name) for name in names]
    for k, name in enumerate(names):
        if name in dark_names and dark_names[k] != name:
            raise InputError(
                f"{dark[k]} would be taken for its view without laser, where one of its own name "
                "is given, too",
                where=lit[k],
                remedy="name all images without laser as those with it, or none",
            )
    return list(range(len(dark)))


def check_partner(exposure: Exposure, partner: Exposure) -> None:
    """Raise `InputError` if a partner is not the same view without laser."""
    _check_pair(exposure, partner)
    _check_scene(exposure, partner)
    _check_laser_side(exposure, partner)


def pair_by_view(exposures: Sequence[Exposure]) -> list[ExposurePair]:
    """Pair exposures that have a laser on with the one of the same view and camera that has none.

    Several exposures may share a partner; an exposure whose view has none is a pair by itself.

    Raises
    ------
    InputError
        If no exposure has a laser on, or as `checked_pairs`.
    """
    lit = [exposure for exposure in exposures if exposure.lasers]
    if not lit:
        raise InputError(
            "no exposure has a laser on",
            remedy="name the lasers in the column 'lasers' of exposures.csv",
        )
    dark: dict[tuple[int, str | None], Exposure] = {
        (e.camera, e.view): e for e in exposures if not e.lasers and e.view is not None
    }
    pairs: list[ExposurePair] = []
    for camera in sorted({exposure.camera for exposure in lit}):
        own = [exposure for exposure in lit if exposure.camera == camera]
        partners = [dark.get((camera, exposure.view)) for exposure in own]
        both = [(e, p) for e, p in zip(own, partners, strict=True) if p is not None]
        if both:
            pairs += checked_pairs([e for e, _ in both], [p for _, p in both])
        pairs += [(e, None) for e, p in zip(own, partners, strict=True) if p is None]
    return pairs


WINDOW_REMEDY = (
    "use images of the camera's full size; if the sensor read a window, say so by is_window = true "
    "under [[camera]] in session.toml, and where it begins by window_x_px and window_y_px, or, "
    "before recording, by windows in rig.toml; if they are whole, the calibration is of another "
    "head: give that of the head that took them"
)


def check_sizes(exposures: Iterable[Exposure], camera: CameraModel) -> None:
    """Raise `InputError` if an exposure is not of the camera's sensor.

    A window may be anywhere on the sensor, also in its corner; an image of which nobody said that
    it is a window must have the full size.
    """
    for exposure in exposures:
        window = exposure.window
        width = window.x_px + exposure.width_px * window.binning
        height = window.y_px + exposure.height_px * window.binning
        is_whole = not window.is_stated and window.x_px == window.y_px == 0 and window.binning == 1
        fits = width <= camera.width_px and height <= camera.height_px
        if not fits or (is_whole and (width, height) != (camera.width_px, camera.height_px)):
            is_window = fits and is_whole
            raise InputError(
                f"the image reaches to {width} x {height} px, the camera was calibrated with "
                f"{camera.width_px} x {camera.height_px} px",
                where=exposure.source,
                remedy=WINDOW_REMEDY
                if is_window
                else "the calibration is of another camera or head, or the images were resized: "
                "give the calibration of the camera that took them",
            )


def _check_pair(exposure: Exposure, partner: Exposure) -> None:
    if exposure.source == partner.source:
        raise InputError(
            "the same image is given with and without laser",
            where=exposure.source,
            remedy="give the image without laser as its partner",
        )
    if exposure.colour != partner.colour:
        raise InputError(
            f"the image with laser is {exposure.colour}, its partner {partner.source} "
            f"{partner.colour}",
            where=exposure.source,
            remedy="give both as the camera took them",
        )
    sizes = [(e.width_px, e.height_px, e.window) for e in (exposure, partner)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"the image with laser has {exposure.width_px} x {exposure.height_px} px, its partner "
            f"{partner.source} {partner.width_px} x {partner.height_px} px, or another window",
            where=exposure.source,
            remedy="check the order of the images: each pair must show one view",
        )


def _check_order(exposures: Sequence[Exposure], partners: Sequence[Exposure]) -> None:
    """Raise `InputError` where an exposure shows another background's view and not its own."""
    if len({(e.width_px, e.height_px, e.window) for e in partners}) > 1:
        return
    lit = np.stack([_structure(exposure) for exposure in exposures])
    dark = np.stack([_structure(partner) for partner in partners])
    likeness = lit @ dark.T
    for k, exposure in enumerate(exposures):
        if _contrast(exposure) < LEAST_CONTRAST:
            continue
        best = int(np.argmax(likeness[k]))
        own, other = float(likeness[k, k]), float(likeness[k, best])
        if other > SAME_VIEW and own < MISORDERED * other:
            raise InputError(
                f"the image looks like {partners[best].source} (correlation {other:.2f}), not like "
                f"its partner {partners[k].source} ({own:.2f})",
                where=exposure.source,
                remedy="check the order of the images with and without laser",
            )


def _check_scene(exposure: Exposure, partner: Exposure) -> None:
    """Raise `InputError` if the two images of a pair show different scenes."""
    contrast = min(_contrast(image) for image in (exposure, partner))
    likeness = float(_structure(exposure) @ _structure(partner))
    if contrast > LEAST_CONTRAST and likeness < OTHER_VIEW:
        raise InputError(
            f"the image does not show the scene of its partner {partner.source} (correlation "
            f"{likeness:.2f})",
            where=exposure.source,
            remedy="give the same view without laser, or no image without laser",
        )


def _check_laser_side(exposure: Exposure, partner: Exposure) -> None:
    """Raise `InputError` if thin bright parts are in the image that should be without laser.

    The brightness of the two is matched first: the partner may be exposed longer.
    """
    n_pixels = exposure.width_px * exposure.height_px
    step = min(max(1, math.isqrt(n_pixels // ENOUGH_PX)), LARGEST_STEP_PX)
    lit, dark = (
        one.image[::step, ::step].astype(np.float32).ravel() for one in (exposure, partner)
    )
    usual = dark <= np.quantile(dark, 1.0 - 10.0 * THIN_SHARE)
    (_, shared), (_, variance) = np.cov(lit[usual], dark[usual])
    gain = max(shared, 0.0) / variance if variance > 0.0 else 0.0
    difference = lit - np.float32(gain) * dark
    below, middle, above = np.quantile(difference, [THIN_SHARE, 0.5, 1.0 - THIN_SHARE]).tolist()
    least = LEAST_CONTRAST * exposure.full_scale
    if middle - below > SWAPPED_RATIO * max(above - middle, least):
        raise InputError(
            f"its partner {partner.source} is the one with thin bright parts: the laser seems to "
            "be on in the wrong image",
            where=exposure.source,
            remedy="swap the images with and without laser",
        )


def _contrast(exposure: Exposure) -> float:
    """Standard deviation of the scene as a part of full scale; bright lines on black are no scene.

    What is bright and thin is taken away: the lines of a laser in a photograph that is exposed for
    them alone.
    """
    scene = grey_opening(_reduced(exposure), size=(THIN_BLOCKS, THIN_BLOCKS))
    return float(scene.std()) / exposure.full_scale


def _reduced(exposure: Exposure) -> FloatArray:
    """Mean grey levels of square blocks, about `REDUCED_PX` of them along the shorter side."""
    grey = exposure.image if exposure.colour == "mono" else exposure.image.mean(axis=2)
    step = max(1, min(exposure.width_px, exposure.height_px) // REDUCED_PX)
    rows, columns = (size // step for size in grey.shape)
    whole = grey[: rows * step, : columns * step].astype(np.float32)
    blocks = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return blocks.astype(np.float64)


def _structure(exposure: Exposure) -> FloatArray:
    """Edges of a reduced image, bright lines clipped, as a vector of length 1."""
    small = np.sqrt(_reduced(exposure))
    edges = np.concatenate([np.diff(small, axis=0).ravel(), np.diff(small, axis=1).ravel()])
    limit = float(np.quantile(np.abs(edges), CLIPPED_SHARE))
    edges = np.clip(edges, -limit, limit)
    length = float(np.linalg.norm(edges))
    return np.asarray(edges / length if length > 0.0 else edges)


def _listed(sources: Sequence[str]) -> str:
    return begun([PurePath(source).name for source in sources], LISTED)


SAME_TIME_NS = 1_000_000
"""Times of two cameras that differ by no more are one instant: those of cameras with one trigger
agree far better, and frames are some 10 ms apart."""
PERIOD_SHARE = 4
"""Nor may they differ by more than this part of the shortest time between two frames."""
PARTNER_MISSING = "the other camera's image is missing"
"""Why a row of a head with two cameras is not measured."""


@dataclass(frozen=True, slots=True)
class Instant:
    """One instant of a scan.

    Parameters
    ----------
    rows
        Rows of the recording, one a camera, in the order of the cameras.
    t_ns
        Mid-exposure time of the first.
    lasers
        Sources that were on, of which the row of one camera is enough; empty if none is named.
    """

    rows: tuple[int, ...]
    t_ns: int
    lasers: tuple[str, ...] = ()


def group_instants(rows: Sequence[ExposureRow], where: str) -> tuple[Instant, ...]:
    """Group exposures by instant: by trigger id where they have one, else by nearly equal time.

    Raises
    ------
    InputError
        If a camera took two exposures at one instant, or its cameras name different lasers.
    """
    groups: dict[tuple[str, int], list[int]] = {}
    untriggered = []
    for k, row in enumerate(rows):
        if row.trigger_id is None:
            untriggered.append(k)
        else:
            groups.setdefault(("trigger", row.trigger_id), []).append(k)
    groups |= _by_time(rows, untriggered)
    instants = []
    for (kind, value), members in groups.items():
        cameras = [rows[k].camera for k in members]
        if len(set(cameras)) != len(cameras):
            most = max(cameras, key=cameras.count)
            raise InputError(
                f"camera {most} has {cameras.count(most)} exposures of one instant "
                f"({kind} {value})",
                where=where,
                remedy="give each exposure of a camera its own time and trigger_id",
            )
        ordered = tuple(sorted(members, key=lambda k: rows[k].camera))
        named = [rows[k].lasers for k in ordered if rows[k].lasers]
        if len({frozenset(lasers) for lasers in named}) > 1:
            raise InputError(
                "the cameras of one instant name different lasers, "
                f"{' and '.join('+'.join(lasers) for lasers in named)} ({kind} {value})",
                where=where,
                remedy="name in the column 'lasers' what was on, alike for all cameras",
            )
        instants.append(Instant(ordered, rows[ordered[0]].t_ns, named[0] if named else ()))
    return tuple(sorted(instants, key=lambda instant: instant.t_ns))


def _by_time(rows: Sequence[ExposureRow], chosen: list[int]) -> dict[tuple[str, int], list[int]]:
    """Rows whose times differ by no more than the tolerance from the first of their group."""
    ordered = sorted(chosen, key=lambda k: (rows[k].t_ns, rows[k].camera))
    last: dict[int, int] = {}
    apart_ns = SAME_TIME_NS * PERIOD_SHARE
    for k in ordered:
        step = rows[k].t_ns - last.get(rows[k].camera, rows[k].t_ns)
        apart_ns = min(apart_ns, step or apart_ns)
        last[rows[k].camera] = rows[k].t_ns
    groups: dict[tuple[str, int], list[int]] = {}
    first_ns = None
    for k in ordered:
        if first_ns is None or rows[k].t_ns - first_ns > apart_ns // PERIOD_SHARE:
            first_ns = rows[k].t_ns
        groups.setdefault(("time", first_ns), []).append(k)
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class InstantImages:
    """What the cameras of a head took at one instant.

    Parameters
    ----------
    pairs
        The exposure of each camera with its partner without laser, left first.
    base_from_sensor
        Where the sensor was; None if unknown.
    instant
        Its rows and time in a scan; of still images there are none.
    profiles
        Stripes of each camera, where these were extracted elsewhere and ``pairs`` is empty.
    """

    pairs: tuple[ExposurePair, ...]
    base_from_sensor: Pose[Base, Sensor] | None = None
    instant: Instant = Instant((), 0)
    profiles: tuple[Profile, ...] = ()

    @property
    def lasers(self) -> tuple[str, ...]:
        """Sources that were on; empty if unknown."""
        named = (self.instant.lasers, *(lit.lasers for lit, _ in self.pairs))
        return next(filter(None, named), ())

    @property
    def t_ns(self) -> int:
        """Mid-exposure time."""
        return self.instant.t_ns


class ScanInstants:
    """Reads the exposures of a scan, one background of each camera at a time in memory.

    Parameters
    ----------
    source
        The scan. If any of its rows names a laser, instants without are taken with the laser off
        and are the background of the exposures of their view and camera; else all have it on. A
        row of which it is not known is neither.
    n_cameras
        Cameras that the scanner has.

    Raises
    ------
    InputError
        If the scan's cameras are not the scanner's, it is of no row known what lasers were on, none
        of its instants with the laser on has the images of all of them, or as `group_instants`.
    """

    def __init__(self, source: ScanSource, n_cameras: int) -> None:
        self._source = source
        cameras = sorted({row.camera for row in source.rows})
        if len(cameras) != n_cameras:
            raise InputError(
                f"the scan holds exposures of camera{'s' if len(cameras) > 1 else ''} "
                f"{', '.join(map(str, cameras))}, the scanner has {n_cameras}",
                where=source.name,
                remedy="the scanner's document is of another head: give the one of this scan",
            )
        instants, n_rows = group_instants(source.rows, source.name), len(source.rows)
        self.is_unknown = np.array([LASER_UNKNOWN in one.flags for one in source.rows], np.bool_)
        """Rows of which nobody knows what lasers were on."""
        if self.is_unknown.all():
            raise InputError(
                f"of none of {n_rows} exposures is it known what lasers were on",
                where=source.name,
                remedy="see that the laser controller answers, and record with a schedule of one "
                "step, fewer triggers a second, or images that bear its trigger ids",
            )
        lit = [k for one in instants if one.lasers for k in one.rows]
        self.is_lit: BoolArray = np.full(n_rows, not lit and not self.is_unknown.any())
        self.is_lit[lit] = ~self.is_unknown[lit]
        self._dark_row = {
            (row.view, row.camera): k
            for k, row in enumerate(source.rows)
            if row.is_dark and not self.is_lit[k] and row.view is not None
        }
        self._dark: dict[int, tuple[int, Exposure]] = {}
        self.lit: tuple[Instant, ...] = tuple(
            one
            for one in instants
            if len(one.rows) == n_cameras and self.is_lit[list(one.rows)].all()
        )
        """Instants at which a laser was on and of which every camera has an image."""
        self.unreadable: dict[int, str] = {}
        """Why rows could not be read, once `read` met them."""
        complete = {row for one in self.lit for row in one.rows}
        lit_rows = np.flatnonzero(self.is_lit).tolist()
        self.without_partner: tuple[int, ...] = tuple(k for k in lit_rows if k not in complete)
        """Rows with the laser on whose instant lacks the image of another camera."""
        if self.without_partner and not self.lit:
            raise InputError(
                f"no instant has the images of all {n_cameras} cameras: "
                f"{len(self.without_partner)} images with laser stand alone",
                where=source.name,
                remedy="give the images of one instant the same trigger_id, or, without trigger "
                f"ids, times within {SAME_TIME_NS / 1e6:g} ms and a quarter of the frame period",
            )

    def read(
        self,
        instants: Sequence[Instant],
        stage: str,
        progress: Progress,
        base_from_sensor: Callable[[Instant], Pose[Base, Sensor] | None] = lambda _: None,
        *,
        clock: StageClock | None = None,
    ) -> Iterator[InstantImages]:
        """Read instants one by one; what cannot be read is left out and kept in `unreadable`.

        Parameters
        ----------
        instants
            Which.
        stage, progress
            Told of every instant.
        base_from_sensor
            Where the sensor was.
        clock
            Counts what decoding takes.
        """
        clock, n = clock or StageClock(), len(instants)
        for done, one in enumerate(instants):
            progress(ProgressEvent(stage, done, n, self._source.rows[one.rows[0]].source))
            try:
                with clock.stage("decoding"):
                    pairs = tuple(self.pair(row) for row in one.rows)
            except ArmscanError as error:
                self.unreadable.update(dict.fromkeys(one.rows, str(error)))
                continue
            yield InstantImages(pairs, base_from_sensor(one), one)
        progress(ProgressEvent(stage, n, n))

    def background_row(self, row: int) -> int | None:
        """Row of the exposure without laser of the same view and camera; None if there is none."""
        view, camera = self._source.rows[row].view, self._source.rows[row].camera
        return None if view is None else self._dark_row.get((view, camera))

    def pair(self, row: int) -> ExposurePair:
        """Read one exposure and its background, if there is one.

        Raises
        ------
        ArmscanError
            If an image cannot be read.
        """
        exposure, camera = self._source.exposure(row), self._source.rows[row].camera
        dark_row = self.background_row(row)
        if dark_row is None:
            return exposure, None
        if camera not in self._dark or self._dark[camera][0] != dark_row:
            self._dark[camera] = (dark_row, self._source.exposure(dark_row))
        return exposure, self._dark[camera][1]


def check_poses(profiles: Sequence[PointProfile], poses: Sequence[Pose[Base, Tool]]) -> None:
    """Raise `InputError` unless there is one pose for each profile."""
    if len(profiles) != len(poses):
        raise InputError(
            f"{len(profiles)} profiles but {len(poses)} poses",
            remedy="give one pose for each profile, in the same order",
        )
