# SPDX-License-Identifier: Apache-2.0
"""The hand-eye of a drawn instrument on a plate and on a sphere, judged against the truth.

The arm's errors turn the head about a point that is drawn, between some hundred millimetres behind
the origin of Tool and the scan point, and shift it; the plate is a sum of waves. The
stripes reach the hand-eye through the sensor as it was calibrated.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import (
    UNDERDETERMINED_MM,
    UNDERDETERMINED_PART,
    calibrate_on_plate,
    calibrate_on_sphere,
)
from armscan.calibration.hand_eye.checks import LIKELIER, MOST_ARM_MM, MOST_OPEN_MM
from armscan.calibration.hand_eye.observations import HandEyeOptions, PlateReference, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import LEVER_MM
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray, IntArray, homogeneous
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Pose
from armscan.geometry.shapes import Plane, fit_plane
from armscan.models.calibration import SensorCalibration
from armscan.reconstruction.triangulate import sensor_columns, triangulate_stripe
from rigs.instrument_stages import Outcome, judged
from rigs.instruments import DEGENERATE, Instrument, Light, Placement, seen_stripe
from rigs.sheet_rig import make_profile

PLATE = Placement(
    Rotation.from_euler("xyz", [12.0, -9.0, 30.0], degrees=True).as_matrix(),
    np.array([420.0, 130.0, 60.0]),
)
N_WAVES = 24
NODES = 8
TOO_FEW = ("too few", "no exposure has a stripe")
AMBIGUOUS = "explain the stripes equally well"
OPEN = (
    "the postures determine only",
    "the postures hardly determine",
    "the postures do not determine",
    AMBIGUOUS,
)
SCATTERS = (
    "the arm would have to scatter by",
    "no hand-eye fits: the stripes of the typical posture lie",
    "no hand-eye puts the points on one sphere",
    "the scatter of arm and stripes or the sensor leaves it open",
)
BLAMES_OTHERS = ("plane left free", "would leave", "would fit", "agree with each other")
"""Words of refusals, by what they say; the last with what else some name as the cause."""
LEAST_TOLD, LEAST_TOLD_ON_SPHERE = 10, 13
"""Numbers that the postures must tell of their poses, four more than there are unknowns. A section
of the sphere tells three, a stripe on a plate two, stripes that cross three: the software refuses
fewer than five, five and four postures."""
CROSSED = 0.2
"""Second extent over the first from which stripes cross (equal ones at their middles: 23 degrees);
below, the software counts them as one."""
TYPICAL_TILT = np.radians(25.0)
"""Of plates against the optical axis."""
TIP_RATIO = (0.1, 0.8)
"""What a tip's calibration errs by over what a touch does: the software expects 0.39."""
MOST_BEHIND_MM = 400.0
N_STARTS = 40
APART_DEG = 1.0
GROUPS = {"rotation": (0, 1, 2), "translation": (3, 4, 5)}


@dataclass(frozen=True)
class Waves:
    """Heights over the plate's plane."""

    vectors: FloatArray
    amplitudes: FloatArray

    @staticmethod
    def draw(made: Instrument, rng: np.random.Generator, n: int, sigma_mm: float) -> Waves:
        """N waves of about the instrument's length, of random direction and phase."""
        length = made.references.flatness_length_mm * rng.uniform(0.6, 1.6, n)
        angle = rng.uniform(0.0, np.pi, n)
        vectors = np.column_stack([np.cos(angle), np.sin(angle)]) * (2.0 * np.pi / length)[:, None]
        return Waves(vectors, sigma_mm / np.sqrt(n) * rng.normal(size=(n, 2)))

    def height(self, places: FloatArray) -> FloatArray:
        """(N,) at places (N, 2 or 3) on the plate."""
        angle = places[:, :2] @ self.vectors.T
        return np.asarray(
            np.cos(angle) @ self.amplitudes[:, 0] + np.sin(angle) @ self.amplitudes[:, 1]
        )

    def features(self, places: FloatArray) -> FloatArray:
        """(N, 2 n) what random amplitudes of one sigma multiply."""
        angle = places[:, :2] @ self.vectors.T
        both = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        return np.asarray(both / np.sqrt(len(self.vectors)))


@dataclass(frozen=True)
class Seen:
    """One exposure: its posture, where the head truly was, and the true points in its frame."""

    posture: int
    head: Placement
    points: FloatArray
    stripe: PosedStripe


def run_hand_eye(
    made: Instrument, sensor: SensorCalibration, lights: dict[int, Light], on_sphere: bool
) -> Outcome:
    """Calibrate the hand-eye; ``lights`` are the true lines by the number of their sheet."""
    rng = made.rng(20 + on_sphere)
    waves = Waves.draw(made, rng, N_WAVES, made.references.flatness_mm)
    heads = sphere_heads(made, rng) if on_sphere else plate_heads(made, rng)
    seen = observed(made, sensor, lights, heads, waves, rng, on_sphere)
    stripes = [one.stripe for one in seen]
    plate = None if on_sphere else probed(made, waves, rng)
    begun = time.process_time()
    try:
        found = _calibrated(made, stripes, sensor, plate)
    except ArmscanError as error:
        found = FitFailure(str(error))
    seconds = time.process_time() - begun
    best = hand_eye_bound(made, seen, sensor.covariance, on_sphere)
    stage = "hand-eye on sphere" if on_sphere else "hand-eye on plate"
    if isinstance(found, FitFailure):
        are_few = are_few_postures(seen, on_sphere)
        limit_mm = _most_open_mm(made, on_sphere)
        is_open = best is None or _open_mm(best) > limit_mm
        if plate is not None and AMBIGUOUS in found.reason:
            is_open |= lead_of_the_likeliest(made, seen, plate, sensor.covariance) < LIKELIER
        result = refusal(made, found.reason, are_few=are_few, is_open=is_open)
        reason = f"few postures: {found.reason}" if are_few else found.reason
        return Outcome(stage, result, reason, seconds=seconds)
    calibration = found.calibration
    covariance, follow = calibration.covariance, calibration.dhand_eye_dsensor
    granted = np.nan
    if follow is not None and found.sensor_covariance is not None:
        stored = hand_eye_bound(made, seen, np.zeros_like(sensor.covariance), on_sphere)
        granted = _over(covariance, stored)
        covariance = covariance + follow @ found.sensor_covariance @ follow.T
    pose, truth = calibration.tool_from_sensor, made.tool_from_sensor
    turn = Rotation.from_matrix(pose.rotation @ truth.rotation.T).as_rotvec()
    error = np.concatenate([turn, pose.translation_mm - truth.shift])
    return judged(
        stage,
        error,
        covariance,
        GROUPS,
        region_factor=calibration.diagnostics.region_factor,
        over_bound=_over(covariance, best),
        over_granted=granted,
        warnings=found.warnings,
        seconds=seconds,
    )


def _over(covariance: FloatArray, best: FloatArray | None) -> float:
    """Geometric mean of standard deviations over those of a bound; NaN where there is none."""
    if best is None:
        return float("nan")
    return float(np.exp(0.5 * np.log(np.diag(covariance) / np.diag(best)).mean()))


def _calibrated(
    made: Instrument,
    stripes: list[PosedStripe],
    sensor: SensorCalibration,
    plate: PlateReference | None,
) -> HandEyeFit | FitFailure:
    if plate is None:
        diameter = made.references.diameter_mm
        return calibrate_on_sphere(stripes, diameter, sensor_covariance=sensor.covariance)
    return calibrate_on_plate(stripes, plate, HandEyeOptions(), sensor_covariance=sensor.covariance)


def refusal(made: Instrument, reason: str, *, are_few: bool, is_open: bool) -> str:
    """Right where the instrument is beyond a limit of the software, and the reason says which.

    ``are_few``: fewer postures than it asks for; ``is_open``: the bound itself leaves more open
    than it takes, or, where other hand-eyes are said to explain the stripes equally well, they do
    so by the true variances.
    """
    is_degenerate = made.fault in DEGENERATE["handeye"]
    is_right = (
        ((are_few or is_degenerate) and _says(reason, TOO_FEW))
        or ((is_open or is_degenerate) and _says(reason, OPEN))
        or (
            arm_scatter_mm(made) > MOST_ARM_MM
            and _says(reason, SCATTERS)
            and not _says(reason, BLAMES_OTHERS)
        )
    )
    return "rightly refused" if is_right else "wrongly refused"


def are_few_postures(seen: Sequence[Seen], on_sphere: bool) -> bool:
    """Whether the postures tell fewer numbers than the software asks for."""
    postures = {one.posture for one in seen}
    if on_sphere:
        return 3 * len(postures) < LEAST_TOLD_ON_SPHERE
    told = 0
    for posture in postures:
        points = np.concatenate([one.points for one in seen if one.posture == posture])
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        told += 3 if extent[1] > CROSSED * extent[0] else 2
    return told < LEAST_TOLD


def _says(reason: str, words: tuple[str, ...]) -> bool:
    return any(one in reason for one in words)


def arm_scatter_mm(made: Instrument) -> float:
    """Of a point at the ends of a stripe, along a plate's normal.

    A turn about an axis of any direction moves the point by its distance from the turning point
    across the normal, which is tilted by `TYPICAL_TILT` against the optical axis to any side.
    """
    half = 0.35 * made.field_mm
    x, y, z = _scan_point(made) - turning_point(made)
    along, aside = np.sin(TYPICAL_TILT) ** 2, 1.0 - 0.5 * np.sin(TYPICAL_TILT) ** 2
    across = np.sqrt(along * z**2 + aside * (x**2 + y**2))
    return float(made.arm.position_mm * np.hypot(1.0, np.hypot(half, across) / made.arm.lever_mm))


def _most_open_mm(made: Instrument, on_sphere: bool) -> float:
    if not on_sphere:
        return MOST_OPEN_MM
    part_mm = UNDERDETERMINED_PART * made.references.diameter_mm
    return min(max(part_mm, UNDERDETERMINED_MM), MOST_OPEN_MM)


def _open_mm(covariance: FloatArray) -> float:
    """Sigma of the combination that is known least, turns by what they move at ``LEVER_MM``."""
    scale = np.array([LEVER_MM] * 3 + [1.0] * 3)
    return float(np.sqrt(np.linalg.eigvalsh(covariance * scale[:, None] * scale)[-1]))


def plate_heads(made: Instrument, rng: np.random.Generator) -> list[Placement]:
    """Base from Sensor of each posture, aimed at the plate."""
    arm, n = made.arm, made.arm.n_postures
    tilt, azimuth = np.radians(rng.uniform(10.0, 40.0, n)), rng.uniform(0.0, 2.0 * np.pi, n)
    roll = rng.uniform(-np.pi, np.pi, n)
    if arm.spread == "one side":
        azimuth = rng.uniform(0.0, 2.0 * np.pi) + np.radians(rng.uniform(-30.0, 30.0, n))
    if arm.spread == "nearly parallel":
        tilt = np.radians(rng.uniform(0.0, 6.0, n))
    if made.fault == "pure translation":
        tilt, azimuth, roll = (np.full(n, value[0]) for value in (tilt, azimuth, roll))
    span = min(0.12 * made.stand_off_mm, 0.15 * made.field_mm)
    away = made.stand_off_mm + rng.uniform(-span, span, n)
    place = rng.uniform(-0.4, 0.4, (n, 2)) * made.references.plate_half_mm
    heads = []
    for k in range(n):
        leaning = np.array([np.cos(azimuth[k]), np.sin(azimuth[k]), 0.0])
        if made.fault == "turns about the plate's normal only":
            leaning, tilt[k], roll[k] = np.array([1.0, 0.0, 0.0]), tilt[0], roll[0]
        z = -(np.cos(tilt[k]) * np.array([0.0, 0.0, 1.0]) + np.sin(tilt[k]) * leaning)
        x = np.cross([0.3, 1.0, 0.2], z)
        x /= np.linalg.norm(x)
        turned = np.column_stack([x, np.cross(z, x), z])
        turned = turned @ Rotation.from_rotvec([0.0, 0.0, roll[k]]).as_matrix()
        if made.fault == "turns about the plate's normal only":
            spin = Rotation.from_rotvec([0.0, 0.0, azimuth[k]]).as_matrix()
            turned = spin @ turned
            away[k] = away[0]
        at = np.array([*place[k], 0.0]) - turned[:, 2] * away[k]
        heads.append(Placement(PLATE.rotation @ turned, PLATE.apply(at[None])[0]))
    return heads


SPHERE_MM = np.array([650.0, -170.0, 35.0])


def sphere_heads(made: Instrument, rng: np.random.Generator) -> list[Placement]:
    """Base from Sensor of postures whose first sheet cuts the sphere at various heights."""
    n, radius = made.arm.n_postures, 0.5 * made.references.diameter_mm
    facing = Rotation.from_rotvec([np.pi, 0.0, 0.2])
    axis = rng.normal(size=3) / np.sqrt(3.0)
    span = min(0.12 * made.stand_off_mm, 0.15 * made.field_mm)
    normal = made.lights[0].normal
    held = Rotation.from_rotvec(0.5 * rng.uniform(-1.0, 1.0, 3))
    heads = []
    for _ in range(n):
        turn = Rotation.from_rotvec(rng.uniform(-0.7, 0.7, 3))
        if made.arm.spread == "one side":
            turn = Rotation.from_rotvec(0.5 * axis + rng.uniform(-0.3, 0.3, 3))
        if made.arm.spread == "nearly parallel":
            turn = Rotation.from_rotvec(rng.uniform(-0.1, 0.1, 3))
        if made.fault in DEGENERATE["handeye"] and made.fault != "two postures":
            turn = held
        rotation = (turn * facing).as_matrix()
        centre = np.array([0.0, 0.0, made.stand_off_mm + 0.6 * radius + rng.uniform(-span, span)])
        centre[:2] += 0.15 * made.field_mm * rng.uniform(-1.0, 1.0, 2)
        off = made.lights[0].height(centre[None])[0]
        centre = centre - (off - rng.uniform(-0.6, 0.6) * radius) * normal
        heads.append(Placement(rotation, SPHERE_MM - rotation @ centre))
    return heads


def lit(
    made: Instrument, light: Light, head: Placement, waves: Waves, on_sphere: bool
) -> FloatArray:
    """(N, 3) points of one line on the plate or the sphere, in the head's frame."""
    rays = light.rays(400)
    if on_sphere:
        radius = 0.5 * made.references.diameter_mm
        centre = head.back(SPHERE_MM[None])[0]
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        towards = centre - light.source
        along = unit @ towards
        inside = radius**2 - (towards @ towards - along**2)
        is_met = inside > 0.0
        points = light.source + (along - np.sqrt(np.maximum(inside, 0.0)))[:, None] * unit
        outward = (points - centre) / radius
        facing = -np.einsum("ni,ni->n", outward, points) / np.linalg.norm(points, axis=1)
        return np.asarray(points[is_met & (facing > 0.3)])
    source = PLATE.back(head.apply(light.source[None]))[0]
    unit = rays @ head.rotation.T @ PLATE.rotation
    distance = -source[2] / unit[:, 2]
    for _ in range(6):
        at = source + distance[:, None] * unit
        distance = distance + (waves.height(at) - at[:, 2]) / unit[:, 2]
    at = source + distance[:, None] * unit
    inside = (np.abs(at[:, :2]) < made.references.plate_half_mm).all(axis=1) & (distance > 0.0)
    return head.back(PLATE.apply(at[inside]))


def observed(
    made: Instrument,
    sensor: SensorCalibration,
    lights: dict[int, Light],
    heads: list[Placement],
    waves: Waves,
    rng: np.random.Generator,
    on_sphere: bool,
) -> list[Seen]:
    """What every exposure gives, through the sensor as it was calibrated."""
    found = []
    share = made.arm.exposure_share
    for k, head in enumerate(heads):
        common = np.sqrt(1.0 - share**2) * _pose_error(made, rng)
        for number in range(made.arm.n_exposures):
            reported = _reported(made, head, common + share * _pose_error(made, rng))
            stripes, sheets, truth = [], [], []
            for sheet, light in lights.items():
                points = lit(made, light, head, waves, on_sphere)
                q, normal, true = seen_stripe(made, points, 0, 45, rng)
                if len(q):
                    stripes.append((q, normal))
                    sheets.append(np.full(len(q), sheet))
                    truth.append(true)
            if not stripes:
                continue
            name = f"image{k:02d}-{number}"
            profile = make_profile(name, stripes, made.claimed[1] * made.stripe_px)
            placed = triangulate_stripe(profile, np.concatenate(sheets), sensor)
            if len(placed) < len(profile):
                continue
            by_all = np.zeros((len(placed), 3, len(sensor.parameter_names)))
            for sheet in lights:
                rows = np.flatnonzero(placed.sheet == sheet)
                columns = sensor_columns(sensor, sheet)
                by_all[np.ix_(rows, np.arange(3), columns)] = placed.by_sensor[rows]
            stripe = PosedStripe(
                source=name,
                posture=f"posture{k:02d}",
                base_from_tool=reported,
                points_mm=placed.points_mm,
                noise_mm=placed.noise_mm,
                sheet=placed.sheet,
                dpoint_dsensor=by_all,
            )
            found.append(Seen(k, head, np.concatenate(truth), stripe))
    return found


def _pose_error(made: Instrument, rng: np.random.Generator) -> FloatArray:
    sigma = made.arm.position_mm
    return rng.normal(size=6) * np.repeat([sigma / made.arm.lever_mm, sigma], 3)


def _scan_point(made: Instrument) -> FloatArray:
    """(3,) in Sensor."""
    return np.array([0.0, 0.0, made.stand_off_mm])


def turning_point(made: Instrument) -> FloatArray:
    """(3,) in Sensor: about which the arm's pose turns.

    Anywhere from the scan point past the origin of Tool to a lever (400 mm at most) behind it, in
    the middle the origin of Tool itself.
    """
    tool = made.tool_from_sensor.back(np.zeros((1, 3)))[0]
    before = _scan_point(made) - tool
    behind = before / np.linalg.norm(before) * min(made.arm.lever_mm, MOST_BEHIND_MM)
    part = made.rng(50).uniform(-1.0, 1.0)
    return np.asarray(tool + part * (before if part > 0.0 else behind))


def _reported(made: Instrument, head: Placement, error: FloatArray) -> Pose:
    centre = head.apply(turning_point(made)[None])[0]
    turn = Rotation.from_rotvec(error[:3]).as_matrix()
    rotation = turn @ head.rotation
    shift = turn @ (head.shift - centre) + centre + error[3:]
    tool = made.tool_from_sensor.rotation
    return Pose(rotation @ tool.T, shift - rotation @ tool.T @ made.tool_from_sensor.shift)


def probed_places(made: Instrument) -> FloatArray:
    """(K, 2) touched places all over the plate."""
    rng = made.rng(30)
    size = 0.95 * made.references.plate_half_mm
    return rng.uniform(-size, size, (made.references.n_probed, 2))


def tip_ratio(made: Instrument) -> float:
    """What the tip's calibration errs by, along one direction, over what a touch does."""
    return float(np.exp(made.rng(32).uniform(*np.log(TIP_RATIO))))


def probed(made: Instrument, waves: Waves, rng: np.random.Generator) -> PlateReference:
    """The plate as touches show it, all of them shifted by what the tip's calibration errs."""
    places = probed_places(made)
    heights = waves.height(places) + made.references.probing_mm * rng.normal(size=len(places))
    heights += made.references.probing_mm * tip_ratio(made) * made.rng(31).normal()
    fitted = fit_plane(PLATE.apply(np.column_stack([places, heights])))
    assert isinstance(fitted, Estimate)
    plane = fitted.value
    if plane.normal @ PLATE.rotation[:, 2] < 0.0:
        plane = Plane(plane.point_mm, plane.axes * np.array([[1.0], [-1.0], [-1.0]]))
    return PlateReference(
        plane=plane,
        covariance=fitted.covariance,
        rms_mm=float(np.sqrt((fitted.residuals**2).mean())),
        n_points=len(places),
    )


def hand_eye_bound(
    made: Instrument, seen: list[Seen], sensor: FloatArray, on_sphere: bool
) -> FloatArray | None:
    """(6, 6) smallest covariance, the sensor's parameters known to theirs (P, P); None for none.

    Some points of each stripe stand for all, their noise lowered accordingly.
    """
    if not seen:
        return None
    rows, noise, lever, owner, known, places = [], [], [], [], [], []
    for number, one in enumerate(seen):
        n = len(one.points)
        chosen = np.linspace(0, n - 1, min(NODES, n)).astype(int)
        points, head = one.points[chosen], one.head
        base = head.apply(points)
        if on_sphere:
            gradient = (base - SPHERE_MM) / np.linalg.norm(base - SPHERE_MM, axis=1)[:, None]
            by_surface = -gradient
            place = base[:, :2]
        else:
            place = PLATE.back(base)[:, :2]
            gradient = np.tile(PLATE.rotation[:, 2], (len(base), 1))
            by_surface = np.column_stack(
                [place / made.references.plate_half_mm, np.ones(len(place))]
            )
        in_tool = points @ made.tool_from_sensor.rotation.T
        in_tool_gradient = gradient @ head.rotation @ made.tool_from_sensor.rotation.T
        rows.append(
            np.column_stack([np.cross(in_tool, in_tool_gradient), in_tool_gradient, by_surface])
        )
        centre = head.apply(turning_point(made)[None])[0]
        lever.append(np.column_stack([np.cross(base - centre, gradient), gradient]))
        in_sensor = gradient @ head.rotation
        size = np.einsum("ni,ni->n", in_sensor, one.stripe.noise_mm[chosen, :, 0])
        noise.append((size / made.claimed[1]) ** 2 * len(chosen) / n)
        known.append(np.einsum("ni,nip->np", in_sensor, one.stripe.dpoint_dsensor[chosen]))
        owner.append(
            np.column_stack([np.full(len(chosen), one.posture), np.full(len(chosen), number)])
        )
        places.append(place)
    design, who = np.concatenate(rows), np.concatenate(owner)
    sigma, share = made.arm.position_mm, made.arm.exposure_share
    scale = np.repeat([sigma / made.arm.lever_mm, sigma], 3)
    pulled = np.concatenate(lever) * scale
    alike = pulled @ pulled.T
    same = [who[:, k][:, None] == who[:, k][None, :] for k in (0, 1)]
    covariance = alike * ((1.0 - share**2) * same[0] + share**2 * same[1])
    by_sensor = np.concatenate(known)
    covariance += by_sensor @ sensor @ by_sensor.T
    covariance += np.diag(np.concatenate(noise))
    if not on_sphere:
        touched = probed_places(made)
        by_touch = np.column_stack([touched / made.references.plate_half_mm, np.ones(len(touched))])
        # A touch lies where the plate is: the plane is met by both with one sign.
        design = np.concatenate([design, np.column_stack([np.zeros((len(touched), 6)), by_touch])])
        whole = np.zeros((len(design), len(design)))
        whole[: len(covariance), : len(covariance)] = covariance
        whole[len(covariance) :, len(covariance) :] = (
            np.eye(len(touched)) + tip_ratio(made) ** 2
        ) * made.references.probing_mm**2
        waves = Waves.draw(made, np.random.default_rng(12345), 300, 1.0)
        shape = waves.features(np.concatenate([*places, touched]))
        covariance = whole + made.references.flatness_mm**2 * shape @ shape.T
    information = design.T @ np.linalg.solve(covariance, design)
    size = np.sqrt(np.diag(information))
    scaled = information / np.outer(size, size)
    if not np.linalg.eigvalsh(scaled)[0] > 1e-12:
        return None
    return np.asarray((np.linalg.inv(scaled) / np.outer(size, size))[:6, :6])


def lead_of_the_likeliest(
    made: Instrument, seen: Sequence[Seen], plate: PlateReference, sensor: FloatArray
) -> float:
    """Logarithm of the likelihood ratio of the likeliest hand-eye and the next, a degree and more
    apart, by the true variances; infinite if there is no other. Means of neighbouring points stand
    for all.

    Each is a minimum of the stripes' distances from the probed plane under their covariance, that
    descents from random rotations end in, all cameras before the plate; what is open beside it
    counts by its determinant.
    """
    rows = [
        (one, part)
        for one in seen
        for part in np.array_split(np.arange(len(one.points)), min(NODES, len(one.points)))
    ]
    normal, point = plate.plane.normal, plate.plane.point_mm
    poses = [one.stripe.base_from_tool for one, _ in rows]
    in_sensor = np.array([one.stripe.points_mm[part].mean(axis=0) for one, part in rows])
    in_tool = np.array([normal @ pose.rotation for pose in poses])
    constants = np.array([normal @ (pose.translation_mm - point) for pose in poses])
    lower = np.linalg.cholesky(_covariance_on_plate(made, rows, sensor))
    found: list[tuple[float, FloatArray]] = []
    random = Rotation.random(N_STARTS, random_state=np.random.default_rng(5)).as_matrix()
    for first in (made.tool_from_sensor.rotation, *random):

        def whitened(x: FloatArray, first: FloatArray = first) -> FloatArray:
            placed = in_sensor @ first.T @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:]
            return np.linalg.solve(lower, (in_tool * placed).sum(axis=1) + constants)

        flat = (in_tool * (in_sensor @ first.T)).sum(axis=1) + constants
        shift = -np.linalg.pinv(in_tool, rcond=1e-6) @ flat
        end = least_squares(whitened, [0.0, 0.0, 0.0, *shift], x_scale=[0.01] * 3 + [1.0] * 3)
        if (in_tool @ end.x[3:] + constants > 0.0).all():
            open_by = float(np.linalg.slogdet(end.jac.T @ end.jac)[1])
            turned = Rotation.from_rotvec(end.x[:3]).as_matrix() @ first
            found.append((-end.cost - 0.5 * open_by, turned))
    found.sort(key=lambda one: -one[0])
    for likelihood, turned in found[1:]:
        apart = Rotation.from_matrix(turned.T @ found[0][1]).magnitude()
        if np.degrees(apart) > APART_DEG:
            return found[0][0] - likelihood
    return float("inf")


def _covariance_on_plate(
    made: Instrument, rows: Sequence[tuple[Seen, IntArray]], sensor: FloatArray
) -> FloatArray:
    """(M, M) of the distances of means of points, ``rows``, from the probed plane."""
    normal, sigma, share = PLATE.rotation[:, 2], made.arm.position_mm, made.arm.exposure_share
    lever, noise, known, places = [], [], [], []
    for one, part in rows:
        base, gradient = one.head.apply(one.points[part]).mean(axis=0), normal @ one.head.rotation
        centre = one.head.apply(turning_point(made)[None])[0]
        lever.append([*(np.cross(base - centre, normal) / made.arm.lever_mm), *normal])
        size = one.stripe.noise_mm[part, :, 0] @ gradient / made.claimed[1]
        noise.append((size**2).mean() / len(part))
        known.append(gradient @ one.stripe.dpoint_dsensor[part].mean(axis=0))
        places.append(PLATE.back(base[None])[0, :2])
    pulled, by_sensor, at = sigma * np.array(lever), np.array(known), np.array(places)
    posture = np.array([one.posture for one, _ in rows])
    exposure = np.array([id(one) for one, _ in rows])
    alike = (1.0 - share**2) * (posture[:, None] == posture)
    alike += share**2 * (exposure[:, None] == exposure)
    covariance = pulled @ pulled.T * alike + by_sensor @ sensor @ by_sensor.T + np.diag(noise)
    touched, tip = probed_places(made), tip_ratio(made)
    by_touch = homogeneous(at) @ np.linalg.pinv(homogeneous(touched))
    waves = Waves.draw(made, np.random.default_rng(12345), 300, 1.0)
    shape = made.references.flatness_mm * (waves.features(at) - by_touch @ waves.features(touched))
    covariance += made.references.probing_mm**2 * (by_touch @ by_touch.T + tip**2)
    return np.asarray(covariance + shape @ shape.T)
