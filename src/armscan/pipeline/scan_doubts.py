# SPDX-License-Identifier: Apache-2.0
"""Whether a scan agrees with itself, and if not, which mistake would explain it.

Where passes disagree far beyond what they claim, or beyond what another reading of the same
recording would leave, the mistakes that people make are undone one after another: images off
by one, a clock that is late, poses that are inverse or read in another convention, mirrored
images, a head that is not where its document says, a jump between two passes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError
from armscan.fusion.point_spool import PointSpool
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotation_from_vector,
    rotations_from_euler,
)
from armscan.models.calibration import ScannerCalibration
from armscan.reconstruction.pass_agreement import (
    PassAgreement,
    Stripes,
    pass_agreement,
    pass_distances,
    passes_of,
    thinned_rows,
)
from armscan.reconstruction.sync import ExposurePoses, largest_gap_ns, poses_at
from armscan.reconstruction.triangulate import intersect_sheets

WARNED_RATIO, WARNED_PAIR = 2.0, 3.0
"""Passes of a sound scan lie 0.3 times what is expected from each other, 0.7 at most (see
docs/explanations/faults.md): the expectation holds what quadrics between stripes leave out."""
SUSPECT_SIGMAS = 2.0
"""Beyond this many times what the points claim, other readings are tried: nothing is said unless
one of them explains it."""
EXPLAINS = 0.4
"""A reading is named if it leaves less than this part of what the scan leaves as read."""
KEEPS = 0.5
"""And if passes overlap at least this much as they did."""
CLAIMED_SIGMAS = 5.0
"""Where no passes overlap as read, a reading must agree within so many times what is claimed,"""
SOUND_RATIO, SOUND_OVERLAP = 0.5, 0.5
"""or as passes of a sound scan do, and over so large a part of the points: on a curved part what
quadrics leave between stripes is far more than is claimed."""
LAGS_MS = (1.0, 3.0, 8.0, 20.0, 50.0, 100.0)
SEARCHED_POINTS = 2500
"""Points with which other readings are tried; the scan as read is compared with all of them."""
SPLIT_RATIO, SPLIT_SHARE = 1.5, 0.7
"""Pairs of passes this far apart, in units of what is expected, are told from the others, and a
break of the scan is named if so large a part of pairs on either side of it and across it fit."""
MOST_THINNED, ESTIMATED_BY = 250_000, 50
"""Thinned points that are compared (30 MB), and exposures by which their count is estimated; of
longer scans some passes are left out whole."""
DENSE_NS = 50_000_000
HAND_EYE_ROUNDS = 6
SHEET_STEP_MM, LARGEST_SHIFT_MM = 0.01, 5.0


@dataclass(frozen=True, slots=True)
class ScanDoubt:
    """What passes say of each other.

    Parameters
    ----------
    agreement
        None where no two passes overlap.
    cause
        The mistake that would explain their disagreement, in words; empty if none was found.
    warnings
        For a person.
    """

    agreement: PassAgreement | None
    cause: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """The recording as it was read, and its thinned points."""

    source: ScanSource
    scanner: ScannerCalibration
    rows: IntArray
    poses: ExposurePoses
    stripes: Stripes
    pixels: FloatArray
    sheet: IntArray

    def coarse(self) -> _Scan:
        """The same with fewer points."""
        step = max(1, len(self.sheet) // SEARCHED_POINTS)
        return replace(
            self,
            stripes=self.stripes.of_rows(np.arange(0, len(self.sheet), step)),
            pixels=self.pixels[::step],
            sheet=self.sheet[::step],
        )

    def at(self, rotations: FloatArray, translations_mm: FloatArray) -> Stripes:
        """The stripes at other poses of the tool, (E, 3, 3) and (E, 3)."""
        hand_eye = self.scanner.hand_eye.tool_from_sensor
        return self.stripes.placed(
            rotations @ hand_eye.rotation, rotations @ hand_eye.translation_mm + translations_mm
        )


def doubt_scan(
    source: ScanSource,
    scanner: ScannerCalibration,
    poses: ExposurePoses,
    *,
    points: PointSpool,
    pose_rows: Sequence[int],
) -> ScanDoubt:
    """Compare the passes of a scan with each other, and look for the mistake if they disagree.

    Parameters
    ----------
    source, scanner, poses
        What the points were made from.
    points
        All measured points, with the pixels where they were seen.
    pose_rows
        Row of the recording with whose pose each exposure kept was placed: that of the first
        camera, for all images of one instant.
    """
    scan = _thinned(source, scanner, poses, points=points, pose_rows=np.array(pose_rows))
    if scan is None:
        return ScanDoubt(None)
    found = pass_agreement(scan.stripes)
    is_off = found is not None and (found.ratio > WARNED_RATIO or found.worst_ratio > WARNED_PAIR)
    if found is not None and not is_off and found.distance_mm < SUSPECT_SIGMAS * found.claimed_mm:
        return ScanDoubt(found)
    if is_off and any(fault.kind == "jump" for fault in poses.track_faults):
        cause, remedy = "the jump of the arm's track explains it", "scan again"
    else:
        cause, remedy = _cause(scan.coarse(), found)
    if found is None:
        start = "passes do not overlap as read, but would agree"
    else:
        start = (
            f"the passes of this scan disagree: they lie {found.distance_mm:.2g} mm apart (median; "
            f"at most {found.worst_mm:.2g} mm), where they claim {found.claimed_mm:.2g} mm"
        )
    if cause:
        return ScanDoubt(found, cause, (f"{start}; {cause}: {remedy}",))
    if is_off:
        advice = "check poses, clock, and that the head and the object did not move; see the cloud"
        return ScanDoubt(found, "", (f"{start}; no common mistake explains it: {advice}",))
    return ScanDoubt(found)


def doubt_times(source: ScanSource, scanner: ScannerCalibration) -> tuple[str, ...]:
    """A sentence where a constant time between camera and arm is left open."""
    has_ids = any(row.trigger_id is not None for row in source.rows)
    is_known = scanner.latency_ns != 0 or scanner.latency_sigma_ns is not None
    if source.session.clock != "related" or has_ids or is_known:
        return ()
    return (
        "the clocks of cameras and arm were related by when their elements arrived, and the "
        "scanner's document holds no latency: a moving hand's points lie off by its speed times "
        "some milliseconds; find it with `armscan calibrate latency`",
    )


def _thinned(
    source: ScanSource,
    scanner: ScannerCalibration,
    poses: ExposurePoses,
    *,
    points: PointSpool,
    pose_rows: IntArray,
) -> _Scan | None:
    if len(points) == 0 or scanner.sensor is None:
        return None
    wanted = _compared_rows(points, pose_rows, source)
    low_mm = points.corners_mm[0]
    columns: list[list[NDArray[Any]]] = [[] for _ in range(5)]
    for (places, exposure), rest in zip(points.places(), points.rest(), strict=True):
        row_of = pose_rows[exposure]
        kept = thinned_rows(places, row_of, low_mm=low_mm)
        kept = kept[np.isin(row_of[kept], wanted)]
        found = (places, rest["covariance_mm2"], rest["pixel_px"], row_of, rest["sheet"])
        for column, values in zip(columns, found, strict=True):
            column.append(values[kept])
    # one after another, so that no more than one is in memory twice
    places_mm, covariance, pixels, row_of, sheet = (
        np.concatenate(columns.pop(0)) for _ in range(len(columns))
    )
    rows, exposure = np.unique(row_of, return_inverse=True)
    hand_eye = scanner.hand_eye.tool_from_sensor
    rotations = poses.rotations[rows] @ hand_eye.rotation
    places = poses.rotations[rows] @ hand_eye.translation_mm + poses.translations_mm[rows]
    local = places_mm - places[exposure]
    times = np.array([source.rows[row].t_ns for row in rows], dtype=np.int64)
    stripes = Stripes(
        np.einsum("mji,mj->mi", rotations[exposure], local),
        covariance,
        exposure,
        passes_of(times),
        rotations,
        places,
    )
    return _Scan(source, scanner, rows, poses, stripes, pixels, sheet.astype(np.int64))


def _compared_rows(points: PointSpool, pose_rows: IntArray, source: ScanSource) -> IntArray:
    """Rows of the recording whose points are compared: all, or those of evenly chosen passes.

    A scan of minutes has more passes than fit into memory with their covariances.
    """
    rows = np.unique(pose_rows)
    if len(points) <= MOST_THINNED:
        return rows
    n_thinned = n_seen = 0
    for k in points.kept[:: max(1, len(points.kept) // ESTIMATED_BY)]:
        cloud = points.of_exposure(int(k))
        n_seen += len(cloud)
        if len(cloud):
            n_thinned += len(thinned_rows(cloud.points_mm, cloud.exposure))
    n_expected = len(points) * n_thinned / max(n_seen, 1)
    if n_expected <= MOST_THINNED:
        return rows
    times = np.array([source.rows[row].t_ns for row in rows], dtype=np.int64)
    passes = passes_of(times)
    n_passes = int(passes[-1]) + 1
    n_taken = max(2, int(n_passes * MOST_THINNED / n_expected))
    taken = np.linspace(0, n_passes - 1, n_taken).astype(np.int64)
    return np.asarray(rows[np.isin(passes, taken)])


def _cause(scan: _Scan, full: PassAgreement | None) -> tuple[str, str]:
    """Words and remedy of the mistake that explains most; empty if none does."""
    best, cause = np.inf, ("", "")
    found = pass_agreement(scan.stripes)
    for words, remedy, stripes in _readings(scan):
        other = pass_agreement(stripes)
        if other is not None and _explains(other, found, scan) and other.distance_mm < 0.9 * best:
            best, cause = other.distance_mm, (words, remedy)
            if best < SUSPECT_SIGMAS * other.claimed_mm:
                break
    if cause[0] or full is None:
        return cause
    # six free parameters bend to much else, so they come last
    return _shifted_passes(scan, full) or _knocked(scan, found)


def _knocked(scan: _Scan, found: PassAgreement | None) -> tuple[str, str]:
    """Whether a head that sits elsewhere on the arm explains the disagreement."""
    moved = _other_hand_eye(scan.stripes)
    other = None if moved is None else pass_agreement(moved[0])
    if moved is None or other is None or not _explains(other, found, scan):
        return "", ""
    return (
        f"a head that sits {moved[1]:.2g} mm and {moved[2]:.2g} deg elsewhere on the arm would "
        "make them agree",
        "the scanner's document is not of this head, or the head was knocked: calibrate again",
    )


def _explains(other: PassAgreement, found: PassAgreement | None, scan: _Scan) -> bool:
    if other.ratio > WARNED_RATIO:
        return False
    if found is None:
        is_sound = other.ratio < SOUND_RATIO and other.n_points > SOUND_OVERLAP * len(scan.sheet)
        is_certain = other.distance_mm < CLAIMED_SIGMAS * other.claimed_mm
        return len(other.pairs) > 1 and (is_sound or is_certain)
    return (
        other.distance_mm < EXPLAINS * found.distance_mm and other.n_points > KEEPS * found.n_points
    )


def _readings(scan: _Scan) -> Iterator[tuple[str, str, Stripes]]:
    """Words, remedy and stripes of each mistake undone."""
    rotations = scan.poses.rotations[scan.rows]
    translations = scan.poses.translations_mm[scan.rows]
    for step in (1, -1, 2, -2):
        which = "before" if step > 0 else "after"
        name = f"the one {which}" if abs(step) == 1 else f"the one but one {which}"
        yield (
            f"giving each exposure the pose of {name} it would make them agree",
            "images and poses, or their trigger ids, are off by "
            f"{'one' if abs(step) == 1 else 'two'}",
            scan.at(np.roll(rotations, step, axis=0), np.roll(translations, step, axis=0)),
        )
    yield from _late(scan)
    yield from _other_poses(scan, rotations, translations)
    yield from _mirrored_images(scan)
    shifted = _other_sheet(scan)
    if shifted is not None:
        stripes, shift_mm = shifted
        yield (
            f"a light sheet that lies {abs(shift_mm):.2g} mm beside the document's would make them "
            "agree",
            "the document is not of this head, or the laser was knocked: calibrate again",
            stripes,
        )


def _late(scan: _Scan) -> Iterator[tuple[str, str, Stripes]]:
    """The clock of the images against that of the arm: the best lag, if there are poses for it."""
    arm = scan.source.arm
    if arm is None or len(arm) < 3 or float(np.median(np.diff(arm.t_ns))) > DENSE_NS:
        return
    times_ns = np.array([scan.source.rows[row].t_ns for row in scan.rows], dtype=np.int64)
    max_gap_ns = largest_gap_ns(arm)

    def at(lag_ms: float) -> tuple[float, Stripes] | None:
        lag_ns = scan.scanner.latency_ns + round(1e6 * lag_ms)
        try:
            poses = poses_at(times_ns + lag_ns, arm, max_gap_ns=max_gap_ns)
        except ArmscanError:
            return None
        has = poses.has_pose
        if has.mean() < KEEPS:
            return None
        used = has[scan.stripes.exposure]
        stripes = scan.at(poses.rotations, poses.translations_mm)
        stripes = stripes.of_rows(np.flatnonzero(used))
        found = pass_agreement(stripes)
        return None if found is None else (found.distance_mm, stripes)

    tried = {lag: at(lag) for size in LAGS_MS for lag in (size, -size)}
    known = {lag: one for lag, one in tried.items() if one is not None}
    if not known:
        return
    best = min(known, key=lambda lag: known[lag][0])
    width = 0.5 * abs(best)
    while width > 0.1:
        for lag in (best - width, best + width):
            one = at(lag)
            if one is not None and one[0] < known[best][0]:
                known[lag], best = one, lag
        width *= 0.5
    which = "late" if best < 0.0 else "early"
    yield (
        f"times of the images that are {abs(best):.2g} ms too {which} would explain it",
        "check the clocks, and what instant of an exposure its time tells",
        known[best][1],
    )


def _other_poses(
    scan: _Scan, rotations: FloatArray, translations: FloatArray
) -> Iterator[tuple[str, str, Stripes]]:
    back = rotations.transpose(0, 2, 1)
    yield (
        "poses that are tool_from_base would make them agree",
        "give base_from_tool: the inverse of these",
        scan.at(back, -np.einsum("nij,nj->ni", back, translations)),
    )
    yield (
        "transposed rotations would make them agree",
        "give the rotations row by row, the tool's axes in the columns",
        scan.at(back, translations),
    )
    x, y, z, w = Rotation.from_matrix(rotations).as_quat().T
    for place, numbers in (("last", (w, x, y, z)), ("first", (y, z, w, x))):
        turned = Rotation.from_quat(np.stack(numbers, axis=1)).as_matrix()
        yield (
            f"quaternions whose scalar stands {place} would make them agree",
            "name the columns qw,qx,qy,qz in the order in which the numbers stand",
            scan.at(turned, translations),
        )
    for factor, unit in ((25.4, "inches"), (10.0, "centimetres"), (1000.0, "metres")):
        yield (
            f"positions of the arm in {unit} would explain it",
            "give the translations of the poses in mm",
            scan.at(rotations, factor * translations),
        )
    for order in ("yxz", "xzy", "zyx", "yzx", "zxy"):
        yield (
            f"positions of the arm whose numbers stand in the order {', '.join(order)} would "
            "explain it",
            "name the columns x_mm,y_mm,z_mm in the order in which the numbers stand",
            scan.at(rotations, translations[:, [order.index(axis) for axis in "xyz"]]),
        )
    for axis, name in enumerate("xyz"):
        mirror = np.eye(3)
        mirror[axis, axis] = -1.0
        yield (
            f"poses of a left-handed frame, mirrored in {name}, would explain it",
            "give poses in a right-handed frame",
            scan.at(mirror @ rotations @ mirror, translations @ mirror),
        )
    names: tuple[EulerConvention, ...] = get_args(EulerConvention)
    for read in names:
        angles = euler_from_rotations(rotations, read)
        for meant in names:
            if meant != read:
                yield (
                    f"angles that were read as {read} but are {meant} would explain it",
                    f'say rotation = "{meant}" under [pose] in session.toml',
                    scan.at(rotations_from_euler(angles, meant), translations),
                )


def _mirrored_images(scan: _Scan) -> Iterator[tuple[str, str, Stripes]]:
    """Images read right to left or bottom up, of a head of one camera."""
    sensor = scan.scanner.sensor
    setup = scan.source.session.cameras[0] if scan.source.session.cameras else None
    if sensor is None or sensor.second is not None or not scan.pixels.any():
        return
    camera = sensor.camera.camera
    size, start = (camera.width_px, camera.height_px), (0, 0)
    if setup is not None:
        binning, given = setup.window.binning, (setup.width_px or 0, setup.height_px or 0)
        # the size is that of the images, or of the whole sensor
        is_of_images = binning * given[0] <= size[0] and binning * given[1] <= size[1]
        each = binning if is_of_images else 1
        size = (each * given[0] or size[0], each * given[1] or size[1])
        start = (setup.window.x_px, setup.window.y_px)
    for axis, words in enumerate(("right to left", "bottom up")):
        pixels = scan.pixels.copy()
        pixels[:, axis] = 2 * start[axis] + size[axis] - 1 - pixels[:, axis]
        points, is_met = intersect_sheets(pixels, scan.sheet, sensor)
        if not is_met.all():
            continue
        yield (
            f"images that are mirrored, {words}, would explain it",
            "switch off the camera's reversal (Reverse X or Y)",
            scan.stripes.with_points(points),
        )


def _other_sheet(scan: _Scan) -> tuple[Stripes, float] | None:
    """The light sheets, shifted along their normals, that make passes agree best; and the shift."""
    sensor = scan.scanner.sensor
    if sensor is None or sensor.second is not None or not scan.pixels.any():
        return None

    def at(shift_mm: float) -> Stripes | None:
        sheets = tuple(
            replace(one, sheet=replace(one.sheet, origin_mm=one.sheet.origin_mm + shift))
            for one in sensor.sheets
            for shift in (shift_mm * one.sheet.axes[2],)
        )
        points, is_met = intersect_sheets(scan.pixels, scan.sheet, replace(sensor, sheets=sheets))
        return scan.stripes.with_points(points) if is_met.all() else None

    shift, stripes = 0.0, at(0.0)
    for _ in range(HAND_EYE_ROUNDS):
        other = at(shift + SHEET_STEP_MM)
        found = None if stripes is None else pass_distances(stripes)
        if stripes is None or other is None or found is None:
            return None
        by_shift = np.zeros(len(found.row))
        for rows, sign in ((found.row, 1.0), (found.nearest, -1.0)):
            turned = stripes.rotations[stripes.exposure[rows]]
            change = (other.points_sensor_mm - stripes.points_sensor_mm)[rows] / SHEET_STEP_MM
            by_shift += sign * np.einsum("ni,nij,nj->n", found.normal, turned, change)
        # the weighted median of what each point asks for: half of them may be wrong
        asked = -found.distance_mm / np.where(by_shift == 0.0, np.inf, by_shift)
        order = np.argsort(asked)
        weight = np.cumsum(np.abs(by_shift)[order])
        step = float(asked[order][int(np.searchsorted(weight, 0.5 * weight[-1]))])
        shift += float(np.clip(step, -LARGEST_SHIFT_MM, LARGEST_SHIFT_MM))
        stripes = at(shift)
    return None if stripes is None else (stripes, shift)


def _other_hand_eye(stripes: Stripes) -> tuple[Stripes, float, float] | None:
    """The hand-eye that makes passes agree best: Gauss-Newton on their distances."""
    given = stripes
    rotation, shift = np.eye(3), np.zeros(3)
    for _ in range(HAND_EYE_ROUNDS):
        found = pass_distances(stripes)
        if found is None or len(found.row) < 100:
            return None
        design = _by_hand_eye(stripes, found.row, found.normal)
        design -= _by_hand_eye(stripes, found.nearest, found.normal)
        left = found.distance_mm
        for _ in range(3):
            scale = robust_sigma(left) + 1e-9
            weight = 1.0 / np.maximum(1.0, np.abs(left) / (2.0 * scale))
            # a weak prior keeps what the passes do not show: 5 mm, 2 degrees
            prior = np.diag(scale / np.array([0.035, 0.035, 0.035, 5.0, 5.0, 5.0]))
            matrix = np.vstack([design * weight[:, None], prior])
            target = np.concatenate([-found.distance_mm * weight, np.zeros(6)])
            step = np.linalg.lstsq(matrix, target, rcond=None)[0]
            left = found.distance_mm + design @ step
        turn = rotation_from_vector(step[:3])
        rotation, shift = turn @ rotation, turn @ shift + step[3:]
        stripes = given.with_points(given.points_sensor_mm @ rotation.T + shift)
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    middle = given.points_sensor_mm.mean(axis=0)
    moved = float(np.linalg.norm(rotation @ middle + shift - middle))
    return stripes, moved, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _by_hand_eye(stripes: Stripes, row: IntArray, normal: FloatArray) -> FloatArray:
    """(N, 6) derivative of the points' places along normals by a turn and shift in Sensor."""
    local = np.einsum("nij,ni->nj", stripes.rotations[stripes.exposure[row]], normal)
    return np.hstack([np.cross(stripes.points_sensor_mm[row], local), local])


def _shifted_passes(scan: _Scan, found: PassAgreement) -> tuple[str, str] | None:
    """A time before and after which passes agree among themselves, but not with each other.

    What is tried: one pass lies off all others, the scan breaks between two passes, or within one.
    """
    n_passes = int(scan.stripes.pass_of.max()) + 1
    pairs = np.array([(pair.surface, pair.other) for pair in found.pairs])
    is_bad = np.array([pair.ratio > SPLIT_RATIO for pair in found.pairs])
    if not is_bad.any() or is_bad.all():
        return None
    times = np.array([scan.source.rows[row].t_ns for row in scan.rows]) / 1e9
    starts = [float(times[scan.stripes.pass_of == k].min()) for k in range(n_passes)]
    best: float = SPLIT_SHARE
    cause: tuple[str, str] | None = None
    for cut in range(n_passes):
        inside = (pairs == cut).any(axis=1)
        apart = {
            "odd": inside,
            "between": (pairs[:, 0] < cut) != (pairs[:, 1] < cut),
            "within": (pairs[:, 0] < cut) != (pairs[:, 1] < cut),
        }
        for kind, is_apart in apart.items():
            asked = ~inside if kind == "within" else np.ones(len(pairs), dtype=np.bool_)
            told = is_apart & asked
            if not told.any() or not (asked & ~told).any():
                continue
            share = min(float(is_bad[told].mean()), float((~is_bad[asked & ~told]).mean()))
            if share > best + 1e-9:
                apart_mm = np.median(
                    [p.distance_mm for p, t in zip(found.pairs, told, strict=True) if t]
                )
                best, cause = share, _split_words(kind, starts[cut], float(apart_mm))
    return cause


def _split_words(kind: str, start_s: float, apart_mm: float) -> tuple[str, str]:
    if kind == "odd":
        return (
            f"only the pass from {start_s:.3f} s lies off the others, by {apart_mm:.2g} mm",
            "its poses are wrong (a hung encoder, repeated samples) or the object moved: leave it "
            "out or scan again",
        )
    where = (
        f"before {start_s:.3f} s" if kind == "between" else f"before the pass at {start_s:.3f} s"
    )
    return (
        f"all {where} agrees, and all after it, but the two lie {apart_mm:.2g} mm apart",
        "the arm was moved or referenced anew there, or the object moved: scan again",
    )
