# SPDX-License-Identifier: Apache-2.0
"""Hand-eye of a camera that sees a flat target at rest from several postures of the arm.

The arm tells ``base_from_tool``, the view ``sensor_from_board``; where both are right,
``base_from_tool tool_from_sensor sensor_from_board`` is the same ``base_from_board`` in every
posture. Neither is exact: a board's pose has the covariance of its points and of the camera, and
the arm's scatters by what `armscan.calibration.hand_eye.noise` estimates. The two unknown poses are
those of generalised least squares under both (Strobl and Hirzinger 2006 weigh so; Shah 2013 names
the problem robot-world and hand-eye).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import betainc, chdtrc

from armscan.calibration.hand_eye.board_looks import (
    N_POSE,
    TURN_MORE,
    BoardLook,
    BoardPose,
    BoardStart,
    Reading,
    better_reading,
    find_board_start,
    middle_of,
    refuse_far,
)
from armscan.calibration.hand_eye.board_result import (
    AskedScale,
    BoardHandEyeFit,
    BoardPosture,
    camera_warnings,
    given_scatter_warnings,
    is_wide,
    refuse_scale,
    scale_warnings,
)
from armscan.calibration.hand_eye.checks import (
    MOST_OPEN_MM,
    conditioning_warnings,
    influence_warnings,
    refuse_hardly_determined,
)
from armscan.calibration.hand_eye.estimate import LeftOut
from armscan.calibration.hand_eye.noise import (
    NoiseComponent,
    NoiseEstimate,
    arm_components,
    arm_noise,
    covariance_over_noise,
    estimate_noise,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import HandEyeOptions, check_postures
from armscan.calibration.hand_eye.result import FINITE_CONDITION
from armscan.calibration.hand_eye.surface import Conditioning, conditioning_of
from armscan.calibration.sheets.board_points import BoardBow
from armscan.errors import EstimationError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import Whitening, pseudo_inverse, scaled_inverse, square_root
from armscan.geometry.poses import Base, Board, Pose, Sensor, Tool
from armscan.geometry.rotations import skew
from armscan.models.calibration import (
    CameraCalibration,
    HandEyeCalibration,
    HandEyeDiagnostics,
    without_covariance,
)
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Target

N_UNKNOWN = 12
LEAST_POSTURES = 4
"""Three have six numbers to spare, of which the scatter of the arm would have to be told."""
MAX_LOOKS = 100
"""Of more, so many are used, evenly spread."""
MAX_STEPS, SETTLED = 30, 1e-3
WRONG_CHANCE = 1e-3
"""Of the worst of all postures; an outlier has less."""
MOST_WRONG = 0.25


def calibrate_on_board(
    looks: Sequence[BoardLook],
    camera: CameraCalibration,
    options: HandEyeOptions | None = None,
    *,
    bow: BoardBow | None = None,
    target: Target | None = None,
    readings: Iterable[Reading] = (),
) -> BoardHandEyeFit | FitFailure:
    """Find where the camera sits on the arm's last link from looks at a target that stays put.

    The looks move the camera, with which the target's poses were found, within its covariance, and
    the calibration belongs to the moved one: ``covariance`` holds that fixed, ``dhand_eye_dsensor``
    (6, 9) says how the hand-eye follows it. ``bow`` is that of the target with which its poses were
    found; None if it is flat. ``target`` is for words about its size. ``readings`` are other ways
    to read the arm's poses, of all looks, that are tried where they do not fit.

    Raises
    ------
    InputError
        If looks of one posture have different poses of the arm.
    """
    options = options or HandEyeOptions()
    check_postures(looks, options)
    refused = _refuse_few(looks)
    if refused is not None:
        return refused
    spread = np.linspace(0, len(looks) - 1, min(len(looks), MAX_LOOKS)).round().astype(np.int64)
    used = [looks[k] for k in spread]
    notes: tuple[str, ...] = ()
    if len(used) < len(looks):
        notes = (f"{len(used)} of {len(looks)} looks at the target were used, evenly spread",)
    others = ((words, do, turns[spread], shifts[spread]) for words, do, turns, shifts in readings)
    found = _calibrated(used, camera, options, bow, target)
    if isinstance(found, FitFailure):
        better = better_reading(used, found.reason, others)
        return found if better is None else better
    if found.not_used or is_wide(found.calibration.arm_noise):
        better = better_reading(used, "the arm's poses and the views hardly agree", others)
        if better is not None:
            return better
    if not camera.has_covariance:
        notes += (without_covariance("the hand-eye's sigmas"),)
    return replace(found, warnings=(*notes, *found.warnings))


def _calibrated(
    looks: Sequence[BoardLook],
    camera: CameraCalibration,
    options: HandEyeOptions,
    bow: BoardBow | None,
    target: Target | None,
) -> BoardHandEyeFit | FitFailure:
    """The hand-eye of poses that mean what they are read as."""
    start = find_board_start(looks)
    if isinstance(start, FitFailure):
        return start
    refused = refuse_far(start, looks, target)
    if refused is not None:
        return refused
    # A scatter that was given does not make looks wrong: which are, the others' own scatter says.
    problem = _Problem.of(looks, start, camera, HandEyeOptions(), bow)
    wrong = _find_wrong(problem, start.is_suspect)
    if isinstance(wrong, FitFailure):
        return wrong
    solution = _solve(replace(problem.without(wrong), options=options))
    if isinstance(solution, FitFailure):
        return solution
    return _evidence(solution, tuple(chain(*wrong.values())), target)


def _refuse_few(looks: Sequence[BoardLook]) -> FitFailure | None:
    n = len({look.posture for look in looks})
    if n >= LEAST_POSTURES:
        return None
    return FitFailure(
        f"{n} posture{'s' if n != 1 else ''} with the target and the arm's pose "
        f"{'are' if n != 1 else 'is'} too few: two poses are unknown, 12 numbers, and the arm's "
        "scatter",
        f"{LEAST_POSTURES} are the least; {TURN_MORE}",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Looks with the state at which they are linearised.

    ``root`` (9 or 11, Q) is a root of the covariance of what all looks have in common, the camera's
    parameters and the target's bow; ``units`` (Q,) are by how much they are off, in its units.
    """

    looks: tuple[BoardLook, ...]
    camera: CameraCalibration
    options: HandEyeOptions
    tool_from_sensor: Pose[Tool, Sensor]
    base_from_board: Pose[Base, Board]
    chosen: tuple[BoardPose, ...]
    root: FloatArray
    units: FloatArray

    @staticmethod
    def of(
        looks: Sequence[BoardLook],
        start: BoardStart,
        camera: CameraCalibration,
        options: HandEyeOptions,
        bow: BoardBow | None,
    ) -> _Problem:
        common = camera.covariance
        if bow is not None:
            follow = np.vstack([np.eye(len(common)), bow.by_cameras])
            common = follow @ common @ follow.T
            common[-2:, -2:] += bow.covariance_mm2
        root = square_root(common, "the covariance of camera and target")
        return _Problem(
            looks=tuple(looks),
            camera=camera,
            options=options,
            tool_from_sensor=start.tool_from_sensor,
            base_from_board=start.base_from_board,
            chosen=tuple(look.poses[k] for look, k in zip(looks, start.chosen, strict=True)),
            root=root,
            units=np.zeros(root.shape[1]),
        )

    @property
    def postures(self) -> dict[str, list[int]]:
        """Rows of the looks of each posture."""
        rows: dict[str, list[int]] = {}
        for k, look in enumerate(self.looks):
            rows.setdefault(look.posture, []).append(k)
        return rows

    def without(self, postures: Collection[str]) -> _Problem:
        """All but some postures."""
        keep = [k for k, look in enumerate(self.looks) if look.posture not in postures]
        return replace(
            self,
            looks=tuple(self.looks[k] for k in keep),
            chosen=tuple(self.chosen[k] for k in keep),
        )

    def moved(self, step: FloatArray) -> _Problem:
        """After a step (12 + Q,) of all unknowns, with the poses that agree best then."""
        moved = replace(
            self,
            tool_from_sensor=self.tool_from_sensor.retract(step[:N_POSE]),
            base_from_board=self.base_from_board.retract(step[N_POSE:N_UNKNOWN]),
            units=self.units + step[N_UNKNOWN:],
        )
        return replace(moved, chosen=tuple(map(moved._nearest, self.looks)))

    @property
    def common(self) -> FloatArray:
        """(9 or 11,) step of the camera's parameters, and of the bow."""
        return np.asarray(self.root @ self.units)

    @property
    def moved_camera(self) -> CameraModel:
        """The camera as the looks move it."""
        camera = self.camera.camera
        return camera.moved_to(camera.parameters + self.common[: len(camera.parameters)])

    def seen(self, pose: BoardPose) -> Pose[Sensor, Board]:
        """The pose of a view under the moved camera and bow."""
        return pose.sensor_from_board.retract(pose.by_common @ self.common)

    def predicted(self, look: BoardLook) -> Pose[Sensor, Board]:
        """Where the look's camera has the board, by arm, hand-eye and mean board."""
        held = look.base_from_tool @ self.tool_from_sensor
        return held.inverse() @ self.base_from_board

    def misclosure_px(self, look: BoardLook, pose: BoardPose) -> FloatArray:
        """(M, 2) where the points of a view are, less where they are predicted."""
        points = self.predicted(look).apply(pose.view.points_board_mm)
        return np.asarray(pose.view.points_px - self.moved_camera.project(points))

    def _nearest(self, look: BoardLook) -> BoardPose:
        if len(look.poses) == 1:
            return look.poses[0]
        predicted = self.predicted(look).rotation
        traces = [float(np.sum(p.sensor_from_board.rotation * predicted)) for p in look.poses]
        return look.poses[int(np.argmax(traces))]

    def system(self) -> _System:
        """Misclosures and their derivatives."""
        n = len(self.looks)
        arm = np.array([look.base_from_tool.rotation for look in self.looks])
        arm_mm = np.array([look.base_from_tool.translation_mm for look in self.looks])
        hand_eye, board = self.tool_from_sensor, self.base_from_board
        views = [self.seen(pose) for pose in self.chosen]
        seen = np.array([pose.rotation for pose in views])
        seen_mm = np.array([pose.translation_mm for pose in views])
        sensor_from_tool = hand_eye.rotation.T
        sensor_from_base = sensor_from_tool @ arm.transpose(0, 2, 1)
        from_arm = board.translation_mm - arm_mm
        in_tool = np.einsum("nji,nj->ni", arm, from_arm) - hand_eye.translation_mm
        predicted = sensor_from_base @ board.rotation
        residual = np.zeros((n, N_POSE))
        residual[:, :3] = Rotation.from_matrix(seen @ predicted.transpose(0, 2, 1)).as_rotvec()
        residual[:, 3:] = seen_mm - in_tool @ hand_eye.rotation
        q = len(self.units)
        jacobian = np.zeros((n, N_POSE, N_UNKNOWN + q + 1))
        jacobian[:, :3, :3] = jacobian[:, 3:, 3:6] = sensor_from_tool
        jacobian[:, 3:, :3] = -sensor_from_tool @ skew(in_tool)
        jacobian[:, :3, 6:9] = jacobian[:, 3:, 9:12] = -sensor_from_base
        jacobian[:, :, N_UNKNOWN:-1] = [pose.by_common @ self.root for pose in self.chosen]
        jacobian[:, 3:, -1] = seen_mm
        prior = np.eye(q, N_UNKNOWN + q + 1, N_UNKNOWN)
        by_arm = np.zeros((3, n, N_POSE, 3))
        by_arm[0][:, 3:] = sensor_from_base
        by_arm[1][:, :3] = by_arm[2][:, :3] = sensor_from_base
        by_arm[1][:, 3:] = -sensor_from_base @ skew(from_arm)
        middles = [pose.sensor_from_board.apply(middle_of(pose.view)) for pose in self.chosen]
        scan_point = arm @ hand_eye.apply(np.mean(middles, axis=0)) + arm_mm
        by_arm[2][:, 3:] = -sensor_from_base @ skew(board.translation_mm - scan_point)
        return _System(
            self,
            np.append(residual.reshape(-1), self.units),
            np.concatenate([jacobian.reshape(-1, N_UNKNOWN + q + 1), prior]),
            np.concatenate([by_arm.reshape(3, -1, 3), np.zeros((3, q, 3))], axis=1),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Misclosures at a state (6 N + Q,), the last those of what is known of the common parameters.

    Their derivative (6 N + Q, 12 + Q + 1) is by hand-eye, board, common parameters and, last, the
    target's scale; that by the arm (3, 6 N + Q, 3) by its shift and its turns about Tool and about
    the scan point.
    """

    problem: _Problem
    residual: FloatArray
    jacobian: FloatArray
    by_arm: FloatArray

    @property
    def components(self) -> tuple[NoiseComponent, ...]:
        """The arm's scatter; looks of one posture share it."""
        names = np.array([look.posture for look in self.problem.looks])
        alike = np.zeros((len(self.residual), len(self.residual)))
        n = N_POSE * len(names)
        alike[:n, :n] = np.kron(names[:, None] == names[None, :], np.ones((N_POSE, N_POSE)))
        options = self.problem.options
        return arm_components(
            [alike * (part @ part.T) for part in self.by_arm],
            options.arm_position_mm,
            options.arm_rotation_rad,
        )

    @property
    def known(self) -> FloatArray:
        """(6 N + Q, 6 N + Q) covariance by the points' noise, and 1 of the common parameters."""
        known = np.eye(len(self.residual))
        for k, pose in enumerate(self.problem.chosen):
            known[_rows(k), _rows(k)] = pose.covariance
        return known


def _rows(k: int) -> slice:
    """Misclosures of a look."""
    return slice(N_POSE * k, N_POSE * (k + 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """A system at its minimum, and the scatter there."""

    system: _System
    noise: NoiseEstimate
    is_settled: bool
    components: tuple[NoiseComponent, ...] = field(repr=False)

    @property
    def total(self) -> FloatArray:
        """Covariance of the misclosures."""
        return total_covariance(self.components, self.noise.sigmas) + self.system.known

    @property
    def jacobian(self) -> FloatArray:
        """Without the scale."""
        return self.system.jacobian[:, :-1]


_NOTHING = FitFailure(
    "the refinement found no minimum: the postures or the scatters given are degenerate", TURN_MORE
)


def _solve(problem: _Problem) -> _Solution | FitFailure:
    """Generalised least squares, the arm's scatter by restricted maximum likelihood."""
    sigmas = None
    for count in range(MAX_STEPS):
        system = problem.system()
        components = system.components
        jacobian = system.jacobian[:, :-1]
        noise = estimate_noise(system.residual, jacobian, components, system.known, sigmas)
        sigmas = noise.sigmas
        total = total_covariance(components, sigmas) + system.known
        linear = solve_linear(system.residual, jacobian, total)
        if linear is None:
            return _NOTHING
        size = float(linear.step @ np.linalg.solve(linear.covariance, linear.step))
        if size < SETTLED**2 * len(linear.step):
            return _Solution(system, noise, True, components)
        if count < MAX_STEPS - 1:
            problem = problem.moved(linear.step)
    return _Solution(system, noise, False, components)


def _find_wrong(
    problem: _Problem, is_suspect: BoolArray
) -> dict[str, tuple[tuple[str, str], ...]] | FitFailure:
    """Postures that all others together call wrong: (source, reason) of their looks.

    Those that the start calls suspect are judged by the others first: together they could hide each
    other. Then the worst that is left, as long as it is wrong. Looks of one posture share the arm's
    error, and would vouch for each other: they are judged together.
    """
    postures = problem.postures
    n, out = len(postures), [name for name, rows in postures.items() if is_suspect[rows].any()]
    found: dict[str, tuple[tuple[str, str], ...]] = {}
    others = _solve(problem.without(out)) if n - len(out) >= LEAST_POSTURES else _NOTHING
    if not isinstance(others, FitFailure):
        found = {name: told for name in out if (told := _contradiction(problem, name, others))}
    while n - len(found) > LEAST_POSTURES + 1:
        solution = _solve(problem.without(found))
        if isinstance(solution, FitFailure):
            return solution
        left = _left_out(solution)
        worst = max(left, key=lambda name: left[name].normalised, default="")
        others = _solve(problem.without([*found, worst]))
        told = () if isinstance(others, FitFailure) else _contradiction(problem, worst, others)
        if not told:
            break
        found[worst] = told
    if len(found) <= MOST_WRONG * n:
        return found
    named = ", ".join(source for told in list(found.values())[:4] for source, _ in told[:1])
    return FitFailure(
        f"{len(found)} of {n} postures contradict the others ({named} ...)",
        "check that poses and images have the same order, and that target and base did not move",
    )


def _contradiction(
    problem: _Problem, posture: str, others: _Solution
) -> tuple[tuple[str, str], ...]:
    """(Source, reason) of a posture's looks if it cannot belong to the others; empty if it may."""
    chance, off_mm, off_deg = _chance(problem, posture, others)
    if chance * len(problem.postures) > WRONG_CHANCE:
        return ()
    reason = (
        f"contradicts the others by {off_mm:.2f} mm and {off_deg:.2f} degrees: a wrong pose, a "
        "moved target, or another numbering of its points"
    )
    rows = problem.postures[posture]
    return tuple((problem.chosen[k].view.source, reason) for k in rows)


def _chance(problem: _Problem, posture: str, others: _Solution) -> tuple[float, float, float]:
    """How likely a posture is so far off what the others say, and how far, in mm and degrees.

    By Hotelling's T^2: the scatter of a posture's numbers is known from as many others as the rest
    has to spare.
    """
    rows = problem.postures[posture]
    alone = replace(
        others.system.problem,
        looks=tuple(problem.looks[k] for k in rows),
        chosen=tuple(problem.chosen[k] for k in rows),
    )
    alone = alone.moved(np.zeros(N_UNKNOWN + len(alone.units)))
    system, own = alone.system(), slice(0, N_POSE * len(rows))
    residual, jacobian = system.residual[own], system.jacobian[own, :-1]
    linear = solve_linear(others.system.residual, others.jacobian, others.total)
    scatter = (total_covariance(system.components, others.noise.sigmas) + system.known)[own, own]
    if linear is not None:
        scatter = scatter + jacobian @ linear.covariance @ jacobian.T
    square = float(residual @ np.linalg.solve(scatter, residual))
    n_free = max(N_POSE * len(others.system.problem.postures) - N_UNKNOWN, 1)
    chance = float(betainc(0.5 * n_free, 0.5 * len(residual), n_free / (n_free + square)))
    turn_deg = float(np.degrees(np.linalg.norm(residual[:3])))
    return chance, _middle_off_mm(alone, 0), turn_deg


def _middle_off_mm(problem: _Problem, row: int) -> float:
    """By how much the target's middle is off, seen from Base."""
    pose, look = problem.chosen[row], problem.looks[row]
    middle = middle_of(pose.view)
    away = problem.seen(pose).apply(middle) - problem.predicted(look).apply(middle)
    return float(np.linalg.norm(away))


def _evidence(
    solution: _Solution, not_used: tuple[tuple[str, str], ...], target: Target | None
) -> BoardHandEyeFit | FitFailure:
    """The result with what it rests on, or why it cannot be trusted."""
    system, problem = solution.system, solution.system.problem
    try:
        stated = covariance_over_noise(
            system.residual, solution.jacobian, solution.components, system.known, solution.noise
        )
        whitened = Whitening(solution.total)(solution.jacobian)
        conditioning = conditioning_of(whitened[:, :N_POSE], whitened[:, N_POSE:])
        asked = _asked_scale(solution)
    except (EstimationError, np.linalg.LinAlgError) as error:
        return FitFailure(f"{_NOTHING.reason} ({error})", TURN_MORE)
    # a wrong size swells the scatter, so that the postures seem to determine little
    refused = refuse_scale(asked, target)
    if refused is None:
        refused = refuse_hardly_determined(conditioning, MOST_OPEN_MM, "", TURN_MORE)
    if refused is not None:
        return refused
    root = problem.root[: len(problem.camera.covariance)]
    after = root @ stated.matrix[N_UNKNOWN:, N_UNKNOWN:] @ root.T
    between = stated.matrix[:N_POSE, N_UNKNOWN:] @ root.T
    follow = between @ scaled_inverse(after)
    covariance = stated.matrix[:N_POSE, :N_POSE]
    own = covariance - follow @ between.T
    left = _left_out(solution)
    misclosures = tuple(map(problem.misclosure_px, problem.looks, problem.chosen))
    postures = tuple(
        _posture(problem, k, left[look.posture], misclosures[k])
        for k, look in enumerate(problem.looks)
    )
    calibration = HandEyeCalibration(
        tool_from_sensor=problem.tool_from_sensor,
        covariance=_positive(own),
        dhand_eye_dsensor=follow,
        arm_noise=arm_noise(solution.components, solution.noise.sigmas),
        rms_mm=_rms_mm(problem),
        n_postures=len({look.posture for look in problem.looks}),
        n_exposures=len(problem.looks),
        n_points=sum(p.n_points for p in postures),
        diagnostics=_diagnostics(
            solution, conditioning.under(covariance), postures, stated.region_factor
        ),
    )
    numbered = dict(enumerate(left.values()))
    told = (
        *influence_warnings(list(left), numbered, own),
        *scale_warnings(asked, target),
    )
    warnings = (
        *(f"{source} {reason}" for source, reason in not_used),
        *conditioning_warnings(conditioning.under(covariance), len(left), ""),
        *camera_warnings(own + follow @ problem.camera.covariance @ follow.T),
        *(given_scatter_warnings(calibration) or told),
        *_scatter_warnings(solution),
    )
    return BoardHandEyeFit(
        calibration=calibration,
        base_from_board=problem.base_from_board,
        board_covariance=stated.matrix[N_POSE:N_UNKNOWN, N_POSE:N_UNKNOWN],
        looks=problem.looks,
        chosen=tuple(
            replace(pose, sensor_from_board=problem.seen(pose)) for pose in problem.chosen
        ),
        postures=postures,
        conditioning=conditioning,
        asked=asked,
        camera=problem.moved_camera,
        camera_step=problem.common[: len(root)],
        camera_covariance=0.5 * (after + after.T),
        before=problem.camera,
        misclosures_px=misclosures,
        not_used=not_used,
        warnings=warnings,
    )


def _positive(covariance: FloatArray) -> FloatArray:
    """The nearest covariance without negative variances, which averages may leave by rounding."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _left_out(solution: _Solution) -> dict[str, LeftOut]:
    """What changes without each posture, as `armscan.calibration.hand_eye.estimate.leave_out`."""
    residual, problem = solution.system.residual, solution.system.problem
    linear = solve_linear(residual, solution.jacobian, solution.total)
    if linear is None:
        return {}
    explained, found = linear.projected @ residual, {}
    for posture, looks in problem.postures.items():
        rows = (N_POSE * np.array(looks)[:, None] + np.arange(N_POSE)).ravel()
        own = pseudo_inverse(linear.projected[np.ix_(rows, rows)], 1e-10)
        predicted = own @ explained[rows]
        square = float(explained[rows] @ predicted)
        size = float(np.sqrt(max(square, 0.0) / len(rows)))
        chance = float(chdtrc(len(rows), square))
        found[posture] = LeftOut(linear.gain[:, rows] @ predicted, size, size, chance)
    return found


def _posture(problem: _Problem, k: int, left: LeftOut, misclosure_px: FloatArray) -> BoardPosture:
    look, pose = problem.looks[k], problem.chosen[k]
    view, predicted = pose.view, problem.predicted(look)
    turn = problem.seen(pose).rotation @ predicted.rotation.T
    return BoardPosture(
        posture=look.posture,
        source=view.source,
        n_points=len(view),
        rms_px=float(np.sqrt((misclosure_px**2).sum(axis=1).mean())),
        shift_mm=_middle_off_mm(problem, k),
        turn_deg=float(np.degrees(Rotation.from_matrix(turn).magnitude())),
        tilt_deg=float(np.degrees(np.arccos(min(abs(predicted.rotation[2, 2]), 1.0)))),
        stand_off_mm=float(np.linalg.norm(pose.sensor_from_board.apply(middle_of(view)))),
        left_out_rotation_deg=float(np.degrees(np.linalg.norm(left.change[:3]))),
        left_out_translation_mm=float(np.linalg.norm(left.change[3:N_POSE])),
        left_out_normalised=left.normalised,
    )


def _rms_mm(problem: _Problem) -> float:
    """Distance of the target's points, placed by view, hand-eye and arm, from the mean board's."""
    squares = []
    for look, pose in zip(problem.looks, problem.chosen, strict=True):
        points, predicted = pose.view.points_board_mm, problem.predicted(look)
        away = problem.seen(pose).apply(points) - predicted.apply(points)
        squares.append((away**2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def _diagnostics(
    solution: _Solution,
    conditioning: Conditioning,
    postures: Sequence[BoardPosture],
    region_factor: float,
) -> HandEyeDiagnostics:
    residual, jacobian = solution.system.residual, solution.jacobian
    linear = solve_linear(residual, jacobian, solution.total)
    square = float("nan") if linear is None else float(residual @ linear.projected @ residual)
    is_estimated = [component.is_estimated for component in solution.components]
    return HandEyeDiagnostics(
        method="board",
        rank=conditioning.rank,
        condition=min(conditioning.condition, FINITE_CONDITION),
        weakest=conditioning.weakest,
        plate_flatness_mm=0.0,
        flatness_length_mm=0.0,
        is_noise_estimated=any(is_estimated),
        left_out_rotation_deg=max(one.left_out_rotation_deg for one in postures),
        left_out_translation_mm=max(one.left_out_translation_mm for one in postures),
        chi2_probability=float(chdtrc(len(residual) - jacobian.shape[1], square)),
        region_factor=region_factor,
        is_arm_given=not is_estimated[0],
    )


def _asked_scale(solution: _Solution) -> AskedScale:
    """Solve the target's size along, the scatter estimated anew."""
    system = solution.system
    residual, jacobian, known = system.residual, system.jacobian, system.known
    noise = estimate_noise(residual, jacobian, solution.components, known, solution.noise.sigmas)
    total = total_covariance(solution.components, noise.sigmas) + known
    linear = solve_linear(residual, jacobian, total)
    if linear is None:
        return AskedScale(1.0, float("inf"), float("inf"))
    whole = covariance_over_noise(residual, jacobian, solution.components, known, noise)
    sigma, if_known = (
        float(np.sqrt(matrix[-1, -1])) for matrix in (whole.matrix, linear.covariance)
    )
    return AskedScale(1.0 + float(linear.step[-1]), sigma, if_known)


def _scatter_warnings(solution: _Solution) -> tuple[str, ...]:
    """Warn of an arm that scatters more than robots do, and of a solution that had not settled."""
    found = []
    noise = arm_noise(solution.components, solution.noise.sigmas)
    turn_rad = float(np.hypot(noise.rotation_rad, noise.tool_rotation_rad))
    if solution.components[0].is_estimated and is_wide(noise):
        found.append(
            f"the arm's poses seem to scatter by {noise.position_mm:.2f} mm and "
            f"{np.degrees(turn_rad):.2f} degrees an axis: much even for a robot; a base or target "
            "that moved, poses read while the arm moved, and a poor camera look the same"
        )
    if not solution.is_settled or not solution.noise.is_settled:
        found.append(
            "the refinement had not settled when its steps ran out: the hand-eye may be off by "
            "more than stated"
        )
    return tuple(found)
