# SPDX-License-Identifier: Apache-2.0
"""The calibrations of the software on a drawn instrument, each judged against the truth."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.result import reasons_to_refuse as camera_reasons
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import N_CAMERA, HeadCameras, place_board
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, SheetFit
from armscan.calibration.sheets.result import reasons_to_refuse as sheet_reasons
from armscan.calibration.sheets.solve import BOW_SHARES, LIKELY_BOW
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import pseudo_inverse
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import BOW_TERMS
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.cameras import camera_calibration
from armscan.vision.targets.target import TargetView
from rigs.instrument_bounds import (
    N_TERMS,
    SeenLine,
    SeenPoints,
    bound,
    camera_information,
    light_terms,
    sheet_information,
)
from rigs.instruments import (
    DEGENERATE,
    Instrument,
    Placement,
    board_placements,
    in_camera,
    lens_of,
    lit_on_board,
    seen_stripe,
)
from rigs.sheet_rig import PROVENANCE, make_profile

FOUR_SIGMA = 6.334e-5
"""Probability beyond four standard deviations, both sides."""
HOPELESS_FOCAL = 0.02
"""Relative sigma of the focal length, by the bound, from which a refusal is right."""
FEW_BOARDS = "a line on fewer than two boards"
"""What becomes of sheets that are refused for it: not degenerate, and no fault of the software."""
SAYS_FEW_BOARDS = (
    "no board",
    "no straight stripe",
    "no line is seen on two board placements",
    "fewer than two board placements show a stripe",
    "fewer than two images show",
)
LEAST_REST_MM = 1e-6
"""Of true heights that a sheet's parameters explain."""


@dataclass(frozen=True)
class Outcome:
    """What became of one stage of one instrument.

    ``result`` is right, wrong, rightly refused, wrongly refused or `FEW_BOARDS`; ``chi2`` the joint
    normalised error over ``freedom`` parameters; ``over_bound`` the stated standard deviations over
    the Cramer-Rao bound, ``over_granted`` over that of the question that is answered: sheets of the
    stored camera, planes that may be bowed as is likely, the hand-eye of the stored sensor.
    """

    stage: str
    result: str
    reason: str = ""
    chi2: float = float("nan")
    freedom: float = 0
    groups: dict[str, float] = field(default_factory=dict)
    over_bound: float = float("nan")
    over_granted: float = float("nan")
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0

    def as_row(self) -> dict[str, object]:
        """For a line of JSON."""
        return asdict(self)


def is_beyond(square: float, freedom: int) -> bool:
    """Whether a normalised error is less likely than four standard deviations of one number."""
    return square > float(chi2.isf(FOUR_SIGMA, freedom))


def quadratic(error: FloatArray, covariance: FloatArray) -> float:
    """``e' C^-1 e``, scaled to a unit diagonal first."""
    sigma = np.sqrt(np.diag(covariance))
    scaled = error / sigma
    return float(scaled @ np.linalg.solve(covariance / np.outer(sigma, sigma), scaled))


def judged(
    stage: str,
    error: FloatArray,
    covariance: FloatArray,
    groups: dict[str, Sequence[int]],
    *,
    region_factor: float = 1.0,
    **more: object,
) -> Outcome:
    """Right if the joint error and that of each group of parameters are within four sigma.

    ``region_factor`` is stated beside the covariance where tails are longer than normal ones.
    """
    square = quadratic(error, covariance)
    parts = {}
    is_wrong = is_beyond(square / region_factor, len(error))
    for name, rows in groups.items():
        chosen = np.array([k for k in rows if k < len(error)])
        if len(chosen):
            own = quadratic(error[chosen], covariance[np.ix_(chosen, chosen)])
            parts[name] = own / len(chosen)
            is_wrong |= is_beyond(own / region_factor, len(chosen))
    return Outcome(
        stage,
        "wrong" if is_wrong else "right",
        chi2=square,
        freedom=len(error),
        groups=parts,
        **more,  # type: ignore[arg-type]
    )


@dataclass
class Views:
    """Targets as found, and what the bound needs of them."""

    found: list[TargetView]
    seen: list[SeenPoints]


def views_of(made: Instrument, places: Sequence[Placement], side: int, stage: int) -> Views:
    """What a detector with Gaussian noise finds; its claim errs by a factor."""
    rng = np.random.default_rng([made.seed, 2000 + 10 * stage + side])
    lens, views = lens_of(made, side), Views([], [])
    for k, place in enumerate(places):
        q = lens.project(in_camera(made, place.apply(made.target.made), side))
        index = np.flatnonzero(lens.sees(q))
        noisy = q[index] + made.target_px * rng.normal(size=(len(index), 2))
        claimed = (made.claimed[0] * made.target_px) ** 2
        views.found.append(
            TargetView(
                source=f"{'left' if side == 0 else 'right'}{stage}-{k:02d}.png",
                width_px=lens.width_px,
                height_px=lens.height_px,
                point_index=index,
                points_px=noisy,
                covariance_px2=np.tile(claimed * np.eye(2), (len(index), 1, 1)),
                points_board_mm=made.target.stated[index],
            )
        )
        views.seen.append(SeenPoints(place, side, index))
    return views


@dataclass(frozen=True)
class CameraResult:
    """A calibrated camera for the stages that follow, and the information that it rests on."""

    outcome: Outcome
    calibration: CameraCalibration
    information: FloatArray


CAMERA_GROUPS = {"focal": (0, 1), "centre": (2, 3), "distortion": (4, 5, 6, 7, 8)}


def run_camera(made: Instrument, options: CameraOptions | None = None) -> CameraResult:
    """Calibrate the left camera; where it is not right, the stages after get one drawn right."""
    n = 2 if made.fault == "two views" else made.n_views
    places = board_placements(made, made.rng(1), n, for_sheets=False)
    views = views_of(made, places, 0, 1)
    information = camera_information(made, views.seen, 9)
    best = bound(information, 9)
    begun = time.process_time()
    try:
        fit = calibrate_camera(views.found, options)
    except ArmscanError as error:
        fit = FitFailure(str(error))
    seconds = time.process_time() - begun
    outcome = judge_camera(made, fit, best, seconds, len(views.found))
    if isinstance(fit, CameraFit) and outcome.result == "right":
        return CameraResult(outcome, camera_calibration(fit, PROVENANCE), information)
    return CameraResult(outcome, drawn_camera(made), information)


def judge_camera(
    made: Instrument,
    fit: CameraFit | FitFailure,
    best: FloatArray,
    seconds: float,
    n_views: int,
) -> Outcome:
    known = float((np.sqrt(np.diag(best))[:2] / made.left.focal).max())
    is_hopeless = made.fault in DEGENERATE["camera"] or n_views < 3 or known > HOPELESS_FOCAL
    reasons = (fit.reason,) if isinstance(fit, FitFailure) else camera_reasons(fit)
    if reasons or isinstance(fit, FitFailure):
        result = "rightly refused" if is_hopeless else "wrongly refused"
        return Outcome("camera", result, reasons[0], seconds=seconds)
    error, covariance, free, rest = camera_error(made, fit)
    ratio = np.sqrt(np.diag(covariance) / np.diag(model_bound(best, free)))
    found = judged(
        "camera",
        error,
        covariance,
        CAMERA_GROUPS,
        over_bound=float(np.exp(np.log(ratio).mean())),
        warnings=fit.warnings,
        seconds=seconds,
        reason="" if rest < 4.0 else f"its model misses the rays by {rest:.1f} sigma",
    )
    return found


def model_bound(best: FloatArray, free: Sequence[int]) -> FloatArray:
    """Bound where the parameters that are not free are known."""
    scale = np.sqrt(np.diag(best))
    information = np.linalg.inv(best / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(np.linalg.inv(information[np.ix_(free, free)]))


def camera_error(
    made: Instrument, fit: CameraFit
) -> tuple[FloatArray, FloatArray, list[int], float]:
    """Error of the free parameters, their covariance, which they are, and what they leave.

    The parameters that come nearest to the true rays over the covered part stand for the truth
    where coefficients are held; what remains then is given in the sigmas of the rays.
    """
    free = [k for k in range(9) if fit.covariance[k, k] > 0.0]
    covariance = fit.covariance[np.ix_(free, free)]
    error = fit.camera.parameters - made.left.parameters
    held = [k for k in range(9) if k not in free]
    if not held or not np.any(error[held]):
        return error[free], covariance, free, 0.0
    low, high = fit.coverage.covered_px[:2], fit.coverage.covered_px[2:]
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 9).T), axis=-1).reshape(-1, 2)
    points = made.left.rays(grid)
    by = np.zeros((2 * len(points), 9))
    steps = [1e-2] * 4 + [1e-6] * 5
    for k, h in enumerate(steps):
        step = np.zeros(9)
        step[k] = h
        by[:, k] = (made.left.moved(step).project(points) - made.left.project(points)).ravel() / h
    miss = by @ error
    scaled = np.linalg.lstsq(by[:, free] * steps[0], miss, rcond=None)[0]
    nearest = np.asarray(scaled * steps[0], dtype=np.float64)
    rest = miss - by[:, free] @ nearest
    sigma = np.sqrt(np.einsum("ni,ij,nj->n", by[:, free], covariance, by[:, free]))
    return nearest, covariance, free, float(np.abs(rest / sigma).max())


def drawn_camera(made: Instrument) -> CameraCalibration:
    """A camera as an ideal calibration with enough views would return it."""
    lens, rng = made.left, made.rng(7)
    views = views_of(made, board_placements_of_ten(made), 0, 7)
    best = bound(camera_information(made, views.seen, 9), 9)
    root = np.linalg.cholesky(best + 1e-30 * np.eye(9))
    values = lens.parameters + root @ rng.normal(size=9)
    return CameraCalibration(
        camera=CameraModel.from_parameters(values, lens.width_px, lens.height_px),
        covariance=best,
        has_covariance=True,
        rms_px=made.target_px * np.sqrt(2.0),
        sigma_point_px=made.target_px,
        n_views=10,
        n_points=1000,
        covered_px=np.array([0.0, 0.0, lens.width_px - 1.0, lens.height_px - 1.0]),
        provenance=PROVENANCE,
    )


def board_placements_of_ten(made: Instrument) -> list[Placement]:
    """Ten sound placements, whatever the instrument's own fault is."""
    return board_placements(replace(made, fault=""), made.rng(8), 10, for_sheets=False)


@dataclass(frozen=True)
class SheetResult:
    """Calibrated light sheets."""

    outcome: Outcome
    fit: LaserFit | None
    names: tuple[int, ...] = ()


def run_sheets(
    made: Instrument,
    camera: CameraCalibration | StereoCalibration,
    information: FloatArray,
) -> SheetResult:
    """Calibrate the lights with a calibrated camera, or two."""
    n_cameras = 1 if isinstance(camera, CameraCalibration) else 2
    n = 1 if made.fault == "one board" else made.n_boards
    if len(made.lights) > 5:
        n = min(n, 7)
    places = board_placements(made, made.rng(2), n, for_sheets=True)
    boards, seen, lines = stripes_on_boards(made, camera, places, n_cameras)
    begun = time.process_time()
    try:
        fit = calibrate_sheets(boards, camera) if boards else FitFailure("no board")
    except ArmscanError as error:
        fit = FitFailure(str(error))
    seconds = time.process_time() - begun
    reasons = (fit.reason,) if isinstance(fit, FitFailure) else sheet_reasons(fit)
    if reasons or isinstance(fit, FitFailure):
        result = sheet_refusal(made, reasons[0], _boards_of_lights(made, lines))
        return SheetResult(Outcome("sheet", result, reasons[0], seconds=seconds), None)
    outcome = judge_sheets(made, fit, information, seen, lines, n_cameras, seconds)
    return SheetResult(outcome, fit, tuple(lights_of(made, fit, lines)))


def sheet_refusal(made: Instrument, reason: str, shown: Sequence[int]) -> str:
    """Right of degenerate boards; `FEW_BOARDS` where a line's lack of boards is the reason.

    ``shown`` counts the boards of each line. Lines that boards lack are photographed one at a time
    (`stripes_on_boards`), so that a sheet in the refusal has its line's name.
    """
    if made.fault in DEGENERATE["sheet"]:
        return "rightly refused"
    few = [light.name for light, n in zip(made.lights, shown, strict=True) if n < 2]
    is_named = any(
        reason.startswith(f"sheet {name}: ") and "board placement shows its stripe" in reason
        for name in few
    )
    is_said = any(one in reason for one in SAYS_FEW_BOARDS)
    return FEW_BOARDS if is_named or (few and is_said) else "wrongly refused"


def _boards_of_lights(made: Instrument, lines: Sequence[SeenLine]) -> list[int]:
    return [
        len({id(line.place) for line in lines if line.light == k}) for k in range(len(made.lights))
    ]


def stripes_on_boards(
    made: Instrument,
    camera: CameraCalibration | StereoCalibration,
    places: Sequence[Placement],
    n_cameras: int,
) -> tuple[list[BoardStripes], list[SeenPoints], list[SeenLine]]:
    """Boards as photographed with light, and what the bound needs of them."""
    cameras = HeadCameras.of(camera)
    sides = [views_of(made, places, side, 2) for side in range(n_cameras)]
    rng, is_alone = made.rng(3), made.lasers_alone or not _are_all_shown(made, places)
    boards: list[BoardStripes] = []
    lines: list[SeenLine] = []
    for k, place in enumerate(places):
        poses = [
            estimate_board_pose(side.found[k], cameras.model(c)) for c, side in enumerate(sides)
        ]
        usable = [
            (c, sides[c].found[k], pose)
            for c, pose in enumerate(poses)
            if not isinstance(pose, FitFailure)
        ]
        if not usable:
            continue
        placed = place_board(usable, cameras) if n_cameras == 2 else None
        for c, view, pose in usable:
            stripes, numbers = [], []
            for j, light in enumerate(made.lights):
                q, normal, _ = seen_stripe(made, lit_on_board(made, light, place), c, 40, rng)
                if len(q):
                    stripes.append((q, normal))
                    numbers.append(j)
                    lines.append(SeenLine(place, c, q, normal, j))
            sigma = made.claimed[1] * made.stripe_px
            groups = [[i] for i in range(len(stripes))] if is_alone else [range(len(stripes))]
            for group in groups:
                if not len(group):
                    continue
                name = made.lights[numbers[group[0]]].name if is_alone else "all"
                profile = make_profile(
                    f"laser{c}-{k:02d}-{name}.png", [stripes[i] for i in group], sigma
                )
                lasers = (name,) if is_alone else ()
                boards.append(BoardStripes(profile, view, pose, lasers, None, c, placed, f"{k}"))
    seen = [one for side in sides for one in side.seen]
    return boards, seen, lines


def _are_all_shown(made: Instrument, places: Sequence[Placement]) -> bool:
    """Whether nearly every board shows every line, so that they may be on together."""
    rng = made.rng(4)
    shown = [
        len(seen_stripe(made, lit_on_board(made, light, place), 0, 40, rng)[0]) > 0
        for place in places
        for light in made.lights
    ]
    return bool(np.mean(shown) > 0.8)


def judge_sheets(
    made: Instrument,
    fit: LaserFit,
    information: FloatArray,
    seen: Sequence[SeenPoints],
    lines: Sequence[SeenLine],
    n_cameras: int,
    seconds: float,
) -> Outcome:
    """Each sheet by itself; the worst one is the instrument's result, and the mean its chi2."""
    n_shared = 9 if n_cameras == 1 else 24
    names = lights_of(made, fit, lines)
    bowed = [False] * len(made.lights)
    for sheet, name in zip(fit.sheets, names, strict=True):
        bowed[name] = sheet.is_bow_free
    whole = sheet_information(made, information, seen, lines, n_shared)
    first = len(information)
    likely = _likely_bows(made, fit, names)
    for k, precision in likely.items():
        bow = first + N_TERMS * k + np.arange(3, N_TERMS)
        whole[bow, bow] += precision
    widths = {k: N_TERMS if bowed[k] or k in likely else 3 for k in names}
    best = _light_bounds(whole, first, widths)
    stored = whole[n_shared:, n_shared:]
    best_granted = _light_bounds(stored, first - n_shared, widths)
    given_camera = _given_camera(fit, n_shared)
    squares, freedom, is_wrong = 0.0, 0.0, False
    ratios: list[float] = []
    over_granted: list[float] = []
    groups: dict[str, float] = {}
    for number, (sheet, k) in enumerate(zip(fit.sheets, names, strict=True)):
        points = points_of_light(made, lines, k)
        n = 8 if sheet.covariance[3, 3] > 0.0 else 3
        error, rest = sheet_error(sheet, points, n)
        one = judged(
            "sheet", error, sheet.covariance[:n, :n], {"plane": (0, 1, 2), "bow": (3, 4, 5, 6, 7)}
        )
        is_wrong |= one.result != "right"
        for group, value in one.groups.items():
            groups[group] = max(groups.get(group, 0.0), value)
        light = made.lights[k]
        squares, freedom = squares + one.chi2, freedom + n
        if k in likely and not (light.cone or light.skew):
            freedom -= _not_erred(sheet, given_camera[number])
        _, _, by = sheet.sheet.height_with_jacobian(points)
        for covariance, bounds, found in (
            (given_camera[number], best_granted, over_granted),
            (sheet.covariance, best, ratios),
        ):
            stated = np.einsum("ni,ij,nj->n", by[:, :n], covariance[:n, :n], by[:, :n]).mean()
            terms = light_terms(made, made.lights[k], points, len(bounds[k]))
            least = np.einsum("ni,ij,nj->n", terms, bounds[k], terms).mean()
            found.append(float(np.sqrt(stated / least)))
        groups["shape left over sigma"] = max(
            groups.get("shape left over sigma", 0.0), rest / float(np.sqrt(stated))
        )
    left_out = len(made.lights) - len(set(names))
    reason = f"{left_out} of {len(made.lights)} lines left out" if left_out else ""
    warnings = (*fit.warnings, *(text for sheet in fit.sheets for text in sheet.warnings))
    return Outcome(
        "sheet",
        "wrong" if is_wrong else "right",
        reason,
        squares,
        freedom,
        groups,
        float(np.median(ratios)),
        float(np.median(over_granted)),
        warnings,
        seconds,
    )


def _not_erred(sheet: SheetFit, given_camera: FloatArray) -> float:
    """Of a true plane: what its bow, known to be small beforehand, does not err by.

    Beside a camera that is held the sheet ``H A' W r`` with ``H = (A' W A + P)^-1`` errs by
    ``H A' W A H = H - H P H``; its covariance says H, and what follows the camera.
    """
    precision = np.zeros(N_TERMS)
    precision[3:] = (LIKELY_BOW * sheet.sheet.scale_mm * BOW_SHARES) ** -2.0
    known = given_camera @ (precision[:, None] * given_camera)
    return float(np.trace(np.linalg.solve(sheet.covariance, known)))


def _light_bounds(whole: FloatArray, first: int, widths: dict[int, int]) -> dict[int, FloatArray]:
    """(W, W) bound of the first W terms of each light, whose terms start at ``first``."""
    own = {k: first + N_TERMS * k + np.arange(n) for k, n in sorted(widths.items())}
    used = np.concatenate([np.arange(first), *own.values()])
    # `bound` is of the first unknowns.
    best = bound(whole[np.ix_(used, used)][::-1, ::-1], len(used) - first)[::-1, ::-1]
    ends = np.cumsum([len(rows) for rows in own.values()])
    return {
        k: best[end - len(rows) : end, end - len(rows) : end]
        for (k, rows), end in zip(own.items(), ends, strict=True)
    }


def _given_camera(fit: LaserFit, n_shared: int) -> list[FloatArray]:
    """(8, 8) covariance of each sheet, the cameras being those that are stored."""
    n = len(fit.sheets) * N_TERMS
    camera = np.delete(np.arange(len(fit.covariance)), slice(N_CAMERA, N_CAMERA + n))[:n_shared]
    known = np.diag(fit.covariance)[camera] > 0.0
    camera, sheets = camera[known], slice(N_CAMERA, N_CAMERA + n)
    sigma = np.sqrt(np.diag(fit.covariance)[camera])
    cross = fit.covariance[sheets, camera] / sigma
    alike = fit.covariance[np.ix_(camera, camera)] / np.outer(sigma, sigma)
    given = fit.covariance[sheets, sheets] - cross @ pseudo_inverse(alike, 1e-15) @ cross.T
    return [given[N_TERMS * k :, N_TERMS * k :][:N_TERMS, :N_TERMS] for k in range(len(fit.sheets))]


def _likely_bows(made: Instrument, fit: LaserFit, names: Sequence[int]) -> dict[int, FloatArray]:
    """(5,) precision of the bow's terms of each light of which no test asked for one."""
    half = 0.5 * made.field_mm
    degrees = np.array([sum(term) for term in BOW_TERMS])
    return {
        k: (
            LIKELY_BOW
            * BOW_SHARES
            * sheet.sheet.scale_mm
            * (half / sheet.sheet.scale_mm) ** degrees
        )
        ** -2.0
        for sheet, k in zip(fit.sheets, names, strict=True)
        if not sheet.is_bow_free and sheet.covariance[3, 3] > 0.0
    }


def points_of_light(made: Instrument, lines: Sequence[SeenLine], k: int) -> FloatArray:
    """(N, 3) true points of one line on the boards that a camera sees: no scan has others."""
    shown = []
    for line in lines:
        if line.light == k:
            points = lit_on_board(made, made.lights[k], line.place, 60)
            seen = lens_of(made, line.side).project(in_camera(made, points, line.side))
            shown.append(points[lens_of(made, line.side).sees(seen)])
    return np.concatenate(shown)


def lights_of(made: Instrument, fit: LaserFit, lines: Sequence[SeenLine]) -> list[int]:
    """The true line of each calibrated sheet: that of which most of its points are.

    Where a fault was put into all points, the one nearest to the sheet. That is no rule for the
    others: a camera whose centre errs turns all sheets, by more than lines may lie apart.
    """
    drew = {tuple(point): line.light for line in lines for point in line.pixels.tolist()}
    found = []
    for k, sheet in enumerate(fit.sheets):
        of_sheet = Counter(
            drew[tuple(point)]
            for image in fit.images
            for point in image.profile.points_px[image.sheet == k].tolist()
            if tuple(point) in drew
        )
        found.append(of_sheet.most_common(1)[0][0] if of_sheet else _nearest(made, sheet, lines))
    return found


def _nearest(made: Instrument, sheet: SheetFit, lines: Sequence[SeenLine]) -> int:
    shown = [k for k, n in enumerate(_boards_of_lights(made, lines)) if n]
    miss = [
        float((sheet.sheet.height_with_jacobian(points_of_light(made, lines, k))[0] ** 2).mean())
        for k in shown
    ]
    return shown[int(np.argmin(miss))]


def sheet_error(sheet: SheetFit, points: FloatArray, n: int) -> tuple[FloatArray, float]:
    """(n,) error of a sheet's parameters over true points, and the rms height that they leave.

    Of all errors that explain the heights as well as any, the most probable one: a bow along the
    depth does not show on two boards.
    """
    height, _, by = sheet.sheet.height_with_jacobian(points)
    design, stated = by[:, :n], sheet.covariance[:n, :n]
    best = np.linalg.lstsq(design, height, rcond=None)[0]
    rest = float(np.sqrt(((height - design @ best) ** 2).mean()))
    total = design @ stated @ design.T + max(rest, LEAST_REST_MM) ** 2 * np.eye(len(height))
    return np.asarray(stated @ design.T @ np.linalg.solve(total, height)), rest
