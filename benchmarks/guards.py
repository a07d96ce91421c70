# SPDX-License-Identifier: Apache-2.0
"""Refusals and warnings over instruments at random: false alarms, and faults that are missed.

    python benchmarks/guards.py [--runs 6] [--sound 20] [--seed 700000]
                                [--only camera,sheet,handeye]

From points, without images. Cameras and light sheets are the drawn instruments of
`rigs.instruments` (sound ones with five views and more, three boards and more); hand-eyes are on a
plate, from 6 to 18 postures of the arms of `hand_eye_coverage`, with search and checks. Every
instrument is calibrated without a fault and then with each. A fault that moves something is as
large as is stated: of an arm's pose ten times the arm's scatter, of points a part of the pitch.

*Refused* and *warned*: with the faulty view, board or posture *named* in the text, or otherwise. A
warning (or an image that is said to be left out) counts if the same instrument without the fault
does not have it, and if it does not tell what is weak (few views, little varied postures).
*Unsaid*: neither. *Missed*: unsaid, and the result is beyond four of its own sigmas of the truth.
The rest that is unsaid did no harm.
"""

from __future__ import annotations

import argparse
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from hand_eye_coverage import Drawn, between, random_postures
from scipy.spatial.transform import Rotation

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit
from armscan.calibration.cameras.result import reasons_to_refuse as camera_reasons
from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit
from armscan.calibration.sheets.result import reasons_to_refuse as sheet_reasons
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.shapes import Plane
from armscan.vision.targets.target import TargetView
from rigs.instrument_stages import (
    CAMERA_GROUPS,
    camera_error,
    drawn_camera,
    is_beyond,
    judge_sheets,
    judged,
    quadratic,
    run_camera,
    stripes_on_boards,
    views_of,
)
from rigs.instruments import Instrument, board_placements, draw_instrument
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig

COUNTS = (6, 8, 12, 18)
WEAK = (
    "only", "two boards only", "target points in only", "no target points", "less varied",
    "badly determined", "hardly tell", "was not checked", "is known to", "without posture",
)  # fmt: skip
"""Of warnings that tell what is weak."""
COLUMNS = ("refused", "refused, named", "warned", "warned, named", "unsaid", "missed")
Stripes = list[PosedStripe]


@dataclass(frozen=True)
class Said:
    """What a calibration says: a refusal or warnings; and whether its result is wrong."""

    refusal: str = ""
    warnings: tuple[str, ...] = ()
    is_wrong: bool = False


@dataclass(frozen=True)
class Case:
    """One instrument: a calibration by the name of a fault, "" for none, and what names it."""

    calibrate: Callable[[str], Said]
    names: dict[str, tuple[str, ...]]


def kind(text: str) -> str:
    """A warning or a reason without its numbers and names."""
    text = re.sub(r"\b(posture|image|laser|left|right)\d[\w.-]*", "X", text)
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)[:90]


def tried(calibrate: Callable[[], Said]) -> Said:
    """With a typed error taken as a refusal."""
    try:
        return calibrate()
    except ArmscanError as error:
        return Said(str(error))


# --- cameras


def one_of(views: list[TargetView], k: int, points: FloatArray) -> list[TargetView]:
    """With other pixels in one view."""
    return [*views[:k], replace(views[k], points_px=points), *views[k + 1 :]]


def faulty_views(made: Instrument, views: list[TargetView], k: int, fault: str) -> list[TargetView]:
    """Views with a fault, of view k or of all."""
    if fault == "board of other proportions (2 %)":
        longer = np.array([1.02, 1.0, 1.0])
        return [replace(view, points_board_mm=view.points_board_mm * longer) for view in views]
    if fault == "two views":
        return views[:2]
    if fault == "all views parallel":
        alike = replace(made, fault="parallel boards")
        return views_of(made, board_placements(alike, made.rng(1), 6, for_sheets=False), 0, 1).found
    return one_of(views, k, faulty_points(made, views[k], fault))


def faulty_points(made: Instrument, view: TargetView, fault: str) -> FloatArray:
    """(N, 2) pixels of one view with a fault."""
    px, changed = view.points_px, view.points_px.copy()
    middle = 0.5 * np.array([view.width_px, view.height_px])
    half = len(px) // 2
    if fault == "view mirrored":
        changed[:, 0] = view.width_px - 1.0 - px[:, 0]
    elif fault == "points numbered one on":
        changed = np.roll(px, 1, axis=0)
    elif fault == "two points exchanged":
        changed[[0, half]] = px[[half, 0]]
    elif fault == "one point off by a fifth of the pitch":
        changed[half] += 0.2 * float(np.median(np.linalg.norm(np.diff(px, axis=0), axis=1)))
    elif fault == "view ten times noisier":
        noise = np.random.default_rng([made.seed, 5]).normal(size=px.shape)
        changed += 10.0 * max(made.target_px, 0.05) * noise
    elif fault == "view of another zoom (3 %)":
        changed = middle + 1.03 * (px - middle)
    return np.asarray(changed)


CAMERA_FAULTS = (
    "view mirrored", "points numbered one on", "two points exchanged",
    "one point off by a fifth of the pitch", "view ten times noisier",
    "view of another zoom (3 %)", "board of other proportions (2 %)", "two views",
    "all views parallel",
)  # fmt: skip


def camera_case(seed: int) -> Case:
    """A drawn camera."""
    made = replace(draw_instrument(seed), fault="")
    made = replace(made, n_views=max(made.n_views, 6))
    views = views_of(
        made, board_placements(made, made.rng(1), made.n_views, for_sheets=False), 0, 1
    )
    k = made.n_views // 2

    def calibrate(fault: str) -> Said:
        fit = calibrate_camera(faulty_views(made, views.found, k, fault))
        if isinstance(fit, FitFailure):
            return Said(fit.reason)
        return _judged_camera(made, fit)

    name = (views.found[k].source,)
    whole = ("board of other proportions (2 %)", "two views", "all views parallel")
    words = {one: name for one in CAMERA_FAULTS if one not in whole}
    return Case(calibrate, {**words, "board of other proportions (2 %)": ("row to row",)})


def _judged_camera(made: Instrument, fit: CameraFit) -> Said:
    reasons = camera_reasons(fit)
    if reasons:
        return Said("; ".join(reasons), fit.warnings)
    error, covariance, _, _ = camera_error(made, fit)
    found = judged("camera", error, covariance, CAMERA_GROUPS)
    return Said("", fit.warnings, found.result != "right")


# --- light sheets


def bent(board: BoardStripes, sigmas: float) -> BoardStripes:
    """The board with a stripe that its own form curves, by so many of the stripe's sigmas."""
    profile = board.profile
    away = profile.points_px - profile.points_px.mean(axis=0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2][0]
    curve = 1.5 * (along / np.abs(along).max()) ** 2 - 0.5
    shift = (sigmas * profile.sigma_px * curve)[:, None] * profile.normals_px
    return replace(board, profile=replace(profile, points_px=profile.points_px + shift))


def faulty_boards(
    boards: list[BoardStripes], k: int, fault: str, lasers: Sequence[str], field_mm: float
) -> list[BoardStripes]:
    """Boards with a fault in board k."""
    one = boards[k]
    if fault in ("board moved by 1 % of the field", "board off by 15 of its sigmas"):
        pose, known = one.sensor_from_board.value, one.sensor_from_board.covariance[3:, 3:]
        normal = pose.rotation[:, 2]
        shift = 15.0 * float(np.sqrt(normal @ known @ normal)) * normal
        if "field" in fault:
            shift = np.array([0.0, 0.0, 0.01 * field_mm])
        away = Pose(pose.rotation, pose.translation_mm + shift)
        moved = replace(one.sensor_from_board, value=away)
        return [*boards[:k], replace(one, sensor_from_board=moved), *boards[k + 1 :]]
    if fault == "boards bent by 10 stripe sigmas":
        rng = np.random.default_rng(len(boards))
        bend = dict.fromkeys(board.place for board in boards)
        size = {place: 10.0 * float(rng.standard_normal()) for place in bend}
        return [bent(board, size[board.place]) for board in boards]
    if fault == "stripe of another board":
        other = next(b for b in boards if b.lasers == one.lasers and b.place != one.place)
        profile = replace(other.profile, source=one.profile.source)
        return [*boards[:k], replace(one, profile=profile), *boards[k + 1 :]]
    if fault == "wrong laser's label":
        other_name = next(name for name in lasers if (name,) != one.lasers)
        return [*boards[:k], replace(one, lasers=(other_name,)), *boards[k + 1 :]]
    if fault == "one board":
        return [b for b in boards if b.place == one.place]
    return boards


SHEET_FAULTS = (
    "board moved by 1 % of the field", "board off by 15 of its sigmas", "stripe of another board",
    "wrong laser's label", "boards bent by 10 stripe sigmas", "one board",
)  # fmt: skip


def sheet_case(seed: int) -> Case | None:
    """The lights of a drawn instrument, up to three, switched on one at a time."""
    made = replace(draw_instrument(seed), fault="", right=None)
    made = replace(made, seed=2 * seed, lights=made.lights[:3], n_boards=max(made.n_boards, 5))
    camera, information = drawn_camera(made), run_camera(made).information
    places = board_placements(made, made.rng(2), made.n_boards, for_sheets=True)
    boards, seen, lines = stripes_on_boards(made, camera, places, 1)
    lasers = sorted({name for board in boards for name in board.lasers})
    of_first = [k for k, board in enumerate(boards) if board.lasers == boards[0].lasers]
    if len(of_first) < 4:
        return None
    k = of_first[len(of_first) // 2]

    def calibrate(fault: str) -> Said:
        if fault == "wrong laser's label" and len(lasers) < 2:
            return Said(refusal="not possible")
        fit = calibrate_sheets(faulty_boards(boards, k, fault, lasers, made.field_mm), camera)
        if isinstance(fit, FitFailure):
            return Said(fit.reason)
        reasons = sheet_reasons(fit)
        left_out = tuple(f"{one.source}: {one.reason}" for one in fit.skipped)
        of_sheets = tuple(text for sheet in fit.sheets for text in sheet.warnings)
        decisions = [sheet.diagnostics.bow_decision for sheet in fit.sheets]
        kept = tuple(text for text in decisions if text.startswith("a bow does better"))
        warnings = (*fit.warnings, *of_sheets, *left_out, *kept)
        if reasons:
            return Said("; ".join(reasons), warnings)
        return Said("", warnings, _is_wrong(fit))

    def _is_wrong(fit: LaserFit) -> bool:
        return judge_sheets(made, fit, information, seen, lines, 1, 0.0).result != "right"

    of_board = (boards[k].profile.source, f"board {boards[k].place}")
    names = dict.fromkeys(SHEET_FAULTS[:4], of_board)
    return Case(calibrate, {**names, SHEET_FAULTS[4]: ("times larger", "times as much")})


# --- hand-eyes


def reposed(stripes: Stripes, change: Callable[[int, PosedStripe], Pose[Base, Tool]]) -> Stripes:
    """Poses that are reported otherwise, by the number of the stripe's posture."""
    names = list(dict.fromkeys(one.posture for one in stripes))
    return [replace(s, base_from_tool=change(names.index(s.posture), s)) for s in stripes]


def faulty_scan(
    scan: tuple[Stripes, PlateReference], k: int, fault: str, size_mm: float
) -> tuple[Stripes, PlateReference]:
    """A scan with a fault; ``k`` is a posture's number."""
    stripes, plate = scan
    up = size_mm * plate.plane.normal
    names = list(dict.fromkeys(one.posture for one in stripes))
    of = {s.posture: s.base_from_tool for s in stripes}

    def shifted(pose: Pose[Base, Tool], by: FloatArray) -> Pose[Base, Tool]:
        return Pose(pose.rotation, pose.translation_mm + by)

    def exchanged(n: int) -> int:
        return {k: k - 1, k - 1: k}.get(n, n)

    def mirrored(pose: Pose[Base, Tool]) -> Pose[Base, Tool]:
        m = np.diag([1.0, -1.0, 1.0])
        return Pose(m @ pose.rotation @ m, m @ pose.translation_mm)

    changes: dict[str, Callable[[int, PosedStripe], Pose[Base, Tool]]] = {
        "one pose off by 10 arm": lambda n, s: shifted(s.base_from_tool, up * (n == k)),
        "plate bumped half way by 10 arm": lambda n, s: shifted(s.base_from_tool, up * (n >= k)),
        "two poses exchanged": lambda n, s: of[names[exchanged(n)]],
        "poses off by one": lambda n, s: of[names[n - 1]],
        "left-handed poses": lambda n, s: mirrored(s.base_from_tool),
        "poses in metres": lambda n, s: Pose(
            s.base_from_tool.rotation, s.base_from_tool.translation_mm / 1e3
        ),
        "poses inverted": lambda n, s: s.base_from_tool.inverse(),  # type: ignore[return-value]
    }
    if fault in changes:
        stripes = reposed(stripes, changes[fault])
    elif fault == "plate probed 10 arm off":
        plate = replace(plate, plane=Plane(plate.plane.point_mm + up, plate.plane.axes))
    elif fault == "plate tilted by 1 deg":
        turn = Rotation.from_rotvec([np.radians(1.0), 0.0, 0.0]).as_matrix()
        plate = replace(plate, plane=Plane(plate.plane.point_mm, plate.plane.axes @ turn.T))
    elif fault == "sensor's points 2 % too large":
        stripes = [replace(s, points_mm=1.02 * s.points_mm) for s in stripes]
    elif fault == "one exposure of another surface":
        rng = np.random.default_rng(k)
        lost = {s.source for s in stripes if s.posture == names[k]}
        stripes = [
            replace(s, points_mm=s.points_mm + rng.normal(0.0, 5.0, s.points_mm.shape))
            if s.source in lost
            else s
            for s in stripes
        ]
    elif fault == "four postures":
        stripes = [s for s in stripes if s.posture in names[:4]]
    elif fault == "arm that does not turn":
        first = stripes[0].base_from_tool.rotation
        stripes = reposed(stripes, lambda _, s: Pose(first, s.base_from_tool.translation_mm))
    return stripes, plate


HAND_EYE_FAULTS = (
    "one pose off by 10 arm", "plate bumped half way by 10 arm", "two poses exchanged",
    "one exposure of another surface",
    "poses off by one", "left-handed poses", "poses in metres", "poses inverted",
    "plate probed 10 arm off", "plate tilted by 1 deg", "sensor's points 2 % too large",
    "four postures", "arm that does not turn",
)  # fmt: skip


def hand_eye_case(seed: int) -> Case:
    """A drawn arm, and postures over a plate."""
    rng = np.random.default_rng([seed, 3])
    drawn = replace(Drawn.draw(rng, COUNTS), n_exposures=1, arm_mm=between(rng, 0.005, 0.1))
    postures = random_postures(drawn.n_postures, rng)
    rig = PlateRig(postures, drawn.noise, points_per_stripe=90, form_mm=0.2)
    scan, k = rig.draw(seed), drawn.n_postures // 2

    def calibrate(fault: str) -> Said:
        fit = calibrate_on_plate(*faulty_scan(scan, k, fault, 10.0 * drawn.arm_mm))
        if not isinstance(fit, HandEyeFit):
            return Said(f"{fit.reason}; {fit.remedy}")
        stated = fit.calibration
        error = stated.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
        is_wrong = is_beyond(quadratic(error, stated.covariance), 6)
        return Said("", fit.warnings, is_wrong)

    of_posture = dict.fromkeys(HAND_EYE_FAULTS[:4], (scan[0][k].posture, scan[0][k].source))
    words = {
        "poses off by one": "of the one", "left-handed poses": "left-handed",
        "poses in metres": "metres", "poses inverted": "tool_from_base",
        "plate probed 10 arm off": "probed", "plate tilted by 1 deg": "probed",
        "sensor's points 2 % too large": "sensor's calibration",
    }  # fmt: skip
    return Case(calibrate, {**of_posture, **{name: (word,) for name, word in words.items()}})


# --- the study

STAGES: dict[str, tuple[Callable[[int], Case | None], tuple[str, ...]]] = {
    "camera": (camera_case, CAMERA_FAULTS),
    "sheet": (sheet_case, SHEET_FAULTS),
    "handeye": (hand_eye_case, HAND_EYE_FAULTS),
}


def alarms(said: Said) -> set[str]:
    """Kinds of warnings that are no weakness."""
    return {kind(text) for text in said.warnings if not any(word in text for word in WEAK)}


def verdict(said: Said, sound: Said, names: tuple[str, ...]) -> str:
    """The column in which a faulty calibration counts."""

    def is_named(texts: Sequence[str]) -> bool:
        return any(name in text for name in names for text in texts)

    if said.refusal:
        return "refused, named" if is_named([said.refusal]) else "refused"
    if is_named(said.warnings) and not is_named(sound.warnings):
        return "warned, named"
    if alarms(said) - alarms(sound):
        return "warned"
    return "missed" if said.is_wrong else "unsaid"


def cases(stage: str, first: int, count: int) -> Iterator[Case]:
    """So many drawn instruments."""
    found, seed = 0, first
    while found < count:
        case = STAGES[stage][0](seed)
        seed += 1
        if case is not None:
            found += 1
            yield case


def study(stage: str, asked: argparse.Namespace) -> None:
    """Table of faults, then of alarms on sound instruments."""
    counts = {fault: Counter[str]() for fault in STAGES[stage][1]}
    refused, warned, n_wrong, begun = Counter[str](), Counter[str](), 0, time.perf_counter()
    for number, case in enumerate(cases(stage, asked.seed, asked.sound)):
        sound = tried(lambda case=case: case.calibrate(""))
        refused.update([kind(sound.refusal)] if sound.refusal else [])
        warned.update(alarms(sound))
        n_wrong += sound.is_wrong
        if number >= asked.runs or sound.refusal:
            continue
        for fault, count in counts.items():
            said = tried(lambda case=case, fault=fault: case.calibrate(fault))
            if said.refusal != "not possible":
                count[verdict(said, sound, case.names.get(fault, ()))] += 1
    print(f"\n{stage}: {asked.sound} sound instruments from seed {asked.seed}")
    print(f"\n| {stage}: fault | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for fault, count in counts.items():
        print(f"| {fault} | {' | '.join(str(count[one] or '') for one in COLUMNS)} |")
    print(f"\n| {stage}: sound | of {asked.sound} |\n|---|---|")
    for name, found in (("refused", refused), ("warned", warned)):
        for text, n in found.most_common():
            print(f"| {name}: {text} | {n} |")
    print(f"| result beyond four sigma | {n_wrong} |")
    print(f"\n{time.perf_counter() - begun:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="guards: false alarms and misses")
    parser.add_argument("--runs", type=int, default=6, help="instruments given each fault")
    parser.add_argument("--sound", type=int, default=20, help="instruments without a fault")
    parser.add_argument("--seed", type=int, default=700_000)
    parser.add_argument("--only", default=",".join(STAGES))
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    for stage in asked.only.split(","):
        study(stage, asked)


if __name__ == "__main__":
    main()
