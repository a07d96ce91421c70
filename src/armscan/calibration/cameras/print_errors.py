# SPDX-License-Identifier: Apache-2.0
"""What a target's print misses: by how much, how views are numbered by it, and least squares with
every point's own place as an unknown beside the camera.

A point that is printed a little beside its place lies there in every view, and no number of views
averages it. So the places are solved along, as normal variables about where they should be, of the
size that the views' agreement shows (K. Strobl and G. Hirzinger, "More accurate pinhole camera
calibration with imperfect planar target", ICCV workshops 2011, free them altogether).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.linalg import LinAlgError
from scipy.special import fdtrc

from armscan.calibration.cameras.adjustment import SAME_POINT_MM, NormalEquations
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose
from armscan.models.camera import CameraModel
from armscan.vision.targets.detect import Numbering

SIGNIFICANT_SIGMAS = 4.0
FEWEST_VIEWS = 4
LEAST_INDEPENDENT = 0.05
SMOOTH_DEGREE = 3
MOST_SMOOTH = 0.25
"""Of all that a print's points may miss, what smooth misses are at most: fewer points than 34 have
fields of a lower degree."""
SAME_FIELD = 1e-6
LEAST_OF_TARGET = 1e-6
"""Standard deviation of a place, over the target's length, of a print that errs smoothly alone."""
FIRST_OF_TARGET = 1e-3
"""What a smooth error is taken for to be looked for: no print errs by more."""
SMOOTH_P = 1e-3
"""Of a smooth error as large as one that is believed, if there is none."""


@dataclass(frozen=True, slots=True)
class PrintError:
    """How far the target's points miss their places.

    Misses are normal variables, each by itself, but those that are smooth over the print
    (`smooth_fields`), as of paper that was fed too far or is drawn out of square, which may be
    larger.

    Parameters
    ----------
    sigma_mm
        Standard deviation along each axis of the board; 0 where views show none.
    weight
        Variance of a point of unit weight over that of a place: what a miss of 1 mm adds to chi2.
    smooth_share
        1 less the variance of other misses over that of smooth ones.
    n_told
        How many numbers the views tell of the places: each counts as far as it is not held where it
        should be.
    """

    sigma_mm: float
    weight: float
    smooth_share: float = 0.0
    n_told: float = 0.0

    @property
    def is_seen(self) -> bool:
        """Whether the views show one."""
        return self.sigma_mm > 0.0

    def pull(self, missed_mm: FloatArray, fields: FloatArray) -> FloatArray:
        """(P, 2) what draws places that are missed by (P, 2) to where they should be."""
        smooth = np.einsum("pkf,pk->f", fields, missed_mm)
        return np.asarray(self.weight * (self.smooth_share * fields @ smooth - missed_mm))

    def cost(self, missed_mm: FloatArray, fields: FloatArray) -> float:
        """What such misses add to chi2."""
        return -float(np.sum(missed_mm * self.pull(missed_mm, fields)))


NO_ERROR = PrintError(0.0, 0.0)


def smooth_fields(target_mm: FloatArray) -> FloatArray:
    """(P, 2, K) misses of a target's points (P, 2) up to the third degree in their places.

    Of unit length and orthogonal to each other, to shifts and turns, and to a scale, which no view
    tells. A few points have fewer (`MOST_SMOOTH`).
    """
    middle = 0.5 * (target_mm.min(axis=0) + target_mm.max(axis=0))
    x, y = ((target_mm - middle) / max(float(np.ptp(target_mm, axis=0).max()), 1e-9)).T
    none, one = np.zeros_like(x), np.ones_like(x)
    found = [(one, none), (none, one), (x, y), (-y, x), (-x, y), (y, x)]
    for degree in range(2, SMOOTH_DEGREE + 1):
        if len(found) - 2 + 2 * degree > MOST_SMOOTH * (target_mm.size - 4):
            break
        for power in range(degree + 1):
            value = x**power * y ** (degree - power)
            found += [(value, none), (none, value)]
    columns = np.array([np.concatenate(pair) for pair in found]).T
    basis, triangle = np.linalg.qr(columns)
    sizes = np.linalg.norm(columns, axis=0)[: basis.shape[1]]
    is_new = np.abs(np.diag(triangle)) > SAME_FIELD * np.maximum(sizes, 1e-300)
    is_new[:4] = False
    return np.asarray(basis[:, is_new].reshape(2, len(x), -1).transpose(1, 0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class BoardResiduals:
    """Residuals of N points kept, and what a move of a point on its board does to them.

    Parameters
    ----------
    point
        (N,) number of the target's point.
    missed_mm
        (N, 2) what it misses its place by, as far as solved.
    residuals_px
        (N, 2) observed minus predicted.
    by_board
        (N, 2, 2) derivative of the prediction by the point's place along the board's axes.
    by_shared, by_pose
        (N, 2, S) and (N, 2, 6) derivative by the shared unknowns and by the pose of its board.
    information
        (N, 2, 2) inverse covariance of the points.
    board
        (N,) number of the pose in the order of the unknowns.
    view
        (N,) number of the view: two cameras have two views of one board.
    target_mm
        (P, 2) places of the target's points.
    """

    point: IntArray
    missed_mm: FloatArray
    residuals_px: FloatArray
    by_board: FloatArray
    by_shared: FloatArray
    by_pose: FloatArray
    information: FloatArray
    board: IntArray
    view: IntArray
    target_mm: FloatArray

    @staticmethod
    def joined(parts: Sequence[BoardResiduals]) -> BoardResiduals:
        """All of several cameras' points."""
        return BoardResiduals(
            np.concatenate([part.point for part in parts]),
            np.concatenate([part.missed_mm for part in parts]),
            np.concatenate([part.residuals_px for part in parts]),
            np.concatenate([part.by_board for part in parts]),
            np.concatenate([part.by_shared for part in parts]),
            np.concatenate([part.by_pose for part in parts]),
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.board for part in parts]),
            np.concatenate([part.view for part in parts]),
            parts[0].target_mm,
        )

    @property
    def n_points(self) -> int:
        """Count P of the target's points."""
        return len(self.target_mm)

    @property
    def fields(self) -> FloatArray:
        """(P, 2, K) smooth misses of the target's points (`smooth_fields`)."""
        return smooth_fields(self.target_mm)

    @property
    def length_mm(self) -> float:
        """Of the target, along its longer side."""
        return float(np.ptp(self.target_mm, axis=0).max())

    def summed(self, values: FloatArray) -> FloatArray:
        """(P, ...) sums of (N, ...) over each of the target's points."""
        sums = np.zeros((self.n_points, *values.shape[1:]))
        np.add.at(sums, self.point, values)
        return sums

    @property
    def places_missed_mm(self) -> FloatArray:
        """(P, 2) ``missed_mm`` of each of the target's points."""
        missed = np.zeros((self.n_points, 2))
        missed[self.point] = self.missed_mm
        return missed


@dataclass(frozen=True, slots=True)
class TargetError:
    """How far the target's points miss their places.

    Parameters
    ----------
    sigma_mm
        Standard deviation along each axis of the board; 0 where views show none.
    independent_share
        Part of the residuals' variance that is new in every view.
    """

    sigma_mm: float
    independent_share: float


def estimate_target_error(found: BoardResiduals | None, widening: float = 1.0) -> TargetError:
    """Find how far target points miss their places, from how residuals agree between views.

    ``widening`` is that of the points' variance for residuals that are alike in a view: so many
    fewer points agree by chance.
    """
    if found is None or len(np.unique(found.view)) < FEWEST_VIEWS:
        return TargetError(0.0, 1.0)
    residuals, by_board, point = found.residuals_px, found.by_board, found.point
    missed = np.linalg.solve(by_board, residuals[:, :, None])[:, :, 0]
    count = np.bincount(point)
    total = np.stack([np.bincount(point, missed[:, k]) for k in range(2)], axis=1)
    squares = np.bincount(point, np.sum(missed**2, axis=1))
    products = float(np.sum(total**2) - squares.sum())
    pairs = float(np.sum(count * (count - 1)))
    scatter = float(squares.sum()) / (2.0 * len(point))
    if not products > SIGNIFICANT_SIGMAS * 2.0 * scatter * np.sqrt(pairs * widening):
        return TargetError(0.0, 1.0)
    variance = products / (2.0 * pairs)
    explained = variance * float(np.mean(np.sum(by_board**2, axis=(1, 2))))
    share = 1.0 - explained / float(np.mean(np.sum(residuals**2, axis=1)))
    return TargetError(float(np.sqrt(variance)), max(share, LEAST_INDEPENDENT))


def seen_print_error(found: BoardResiduals, variance_factor: float, widening: float) -> PrintError:
    """`estimate_target_error` as a size of the places; `NO_ERROR` where none is seen.

    ``variance_factor`` is sigma0 squared of a solution that takes the print for right.
    """
    seen = estimate_target_error(found, widening)
    if seen.sigma_mm == 0.0:
        return NO_ERROR
    return PrintError(seen.sigma_mm, variance_factor * seen.independent_share / seen.sigma_mm**2)


@dataclass(frozen=True, slots=True, eq=False)
class PrintEliminated:
    """Normal equations of camera and poses after the places of the P points are eliminated.

    Parameters
    ----------
    matrix
        (n, n) of the F free shared unknowns and the 6 V of the poses.
    carried
        (n, 2 P) how these feel what pulls at the places.
    own
        (P, 2, 2) inverse of each place's own normal matrix, but for what smooth misses share.
    shared, middle
        (2 P, K) and (K, K) what they share: the inverse is that of ``own`` and
        ``shared middle shared'``.
    fields
        (2 P, K) smooth misses.
    error
        By which the places are weighed.
    """

    matrix: FloatArray
    carried: FloatArray
    own: FloatArray
    shared: FloatArray
    middle: FloatArray
    fields: FloatArray
    error: PrintError

    def inverse(self) -> FloatArray:
        """(n, n) of ``matrix``.

        Raises
        ------
        LinAlgError
            If something is left open.
        """
        diagonal = np.diag(self.matrix)
        if not diagonal.min() > 0.0:
            raise LinAlgError
        scale = np.sqrt(np.outer(diagonal, diagonal))
        return np.asarray(np.linalg.inv(self.matrix / scale) / scale)

    def n_told(self) -> tuple[float, float]:
        """How many numbers are told of smooth misses, and of all others."""
        inverse, smooth = self.inverse(), self.fields.T @ self.shared
        held = float(np.einsum("pkk->", self.own))
        held += float(np.sum(self.middle * (self.shared.T @ self.shared)))
        held += float(np.sum(self.carried * (inverse @ self.carried)))
        by_smooth = self.carried @ self.fields
        of_smooth = float(np.trace(smooth + smooth @ self.middle @ smooth))
        of_smooth += float(np.sum(by_smooth * (inverse @ by_smooth)))
        weight, n_smooth = self.error.weight, self.fields.shape[1]
        others = 2.0 * len(self.own) - n_smooth - weight * (held - of_smooth)
        return n_smooth - weight * (1.0 - self.error.smooth_share) * of_smooth, others

    def steps(self, pull: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton steps (n,) and (P, 2) for gradients (n,) and (P, 2)."""
        unknowns = self.inverse() @ (pull - self.carried @ places.reshape(-1))
        followed = (self.own @ places[:, :, None]).reshape(-1)
        followed += self.shared @ (self.middle @ (self.shared.T @ places.reshape(-1)))
        return unknowns, (followed - self.carried.T @ unknowns).reshape(-1, 2)

    def covariance(self, basis: FloatArray) -> FloatArray:
        """(S + 6 V, S + 6 V) of the shared unknowns and the poses, in units of sigma0 squared.

        ``basis`` is (S, F).
        """
        inverse, n_free = self.inverse(), basis.shape[1]
        n_poses = len(inverse) - n_free
        lever = np.zeros((len(basis) + n_poses, len(inverse)))
        lever[: len(basis), :n_free] = basis
        lever[len(basis) :, n_free:] = np.eye(n_poses)
        return np.asarray(lever @ (0.5 * (inverse + inverse.T)) @ lever.T)


def eliminate_print(
    equations: NormalEquations, basis: FloatArray, found: BoardResiduals, error: PrintError
) -> PrintEliminated:
    """Eliminate the places, which are normal variables about where they should be; none of a print
    that is not seen to err.

    ``equations`` are those of the points of ``found`` and of whatever else is known, for places
    that are held; ``basis`` (S, F) their free directions.
    """
    n_free, n_poses = basis.shape[1], len(equations.pose)
    size = n_free + 6 * n_poses
    matrix = np.zeros((size, size))
    matrix[:n_free, :n_free] = equations.shared
    for v in range(n_poses):
        rows = slice(n_free + 6 * v, n_free + 6 * v + 6)
        matrix[:n_free, rows], matrix[rows, rows] = equations.cross[v], equations.pose[v]
        matrix[rows, :n_free] = equations.cross[v].T
    n_points = found.n_points if error.is_seen else 0
    cross, normal = np.zeros((n_points, size, 2)), np.zeros((n_points, 2, 2))
    if error.is_seen:
        weighted = found.information @ found.by_board
        normal = found.summed(found.by_board.transpose(0, 2, 1) @ weighted)
        cross[:, :n_free] = found.summed((found.by_shared @ basis).transpose(0, 2, 1) @ weighted)
        by_pose = found.by_pose.transpose(0, 2, 1) @ weighted
        for k in range(6):
            np.add.at(cross, (found.point, n_free + 6 * found.board + k), by_pose[:, k])
    own = np.asarray(np.linalg.inv(normal + error.weight * np.eye(2)), dtype=np.float64)
    every = found.fields
    fields = every[:n_points]
    flat = fields.reshape(2 * n_points, every.shape[2])
    shared = (own @ fields).reshape(flat.shape)
    lent = error.weight * error.smooth_share
    middle = np.asarray(np.linalg.inv(np.eye(flat.shape[1]) - lent * flat.T @ shared) * lent)
    crossed = cross.transpose(1, 0, 2).reshape(size, 2 * n_points)
    carried = (cross @ own).transpose(1, 0, 2).reshape(size, 2 * n_points)
    carried = carried + (crossed @ shared) @ middle @ shared.T
    matrix -= carried @ crossed.T
    return PrintEliminated(matrix, carried, own, shared, middle, flat, error)


def pull_of_places(found: BoardResiduals, error: PrintError) -> FloatArray:
    """(P, 2) gradient of chi2 by the places, as of `NormalEquations`; (0, 2) if none is seen."""
    if not error.is_seen:
        return np.zeros((0, 2))
    weighted = found.information @ found.residuals_px[:, :, None]
    pull = found.summed((found.by_board.transpose(0, 2, 1) @ weighted)[:, :, 0])
    return np.asarray(pull + error.pull(found.places_missed_mm, found.fields))


class PrintSolution(Protocol):
    """A minimum over cameras and poses, for places of the print that are held."""

    @property
    def basis(self) -> FloatArray:
        """(S, F) free directions of the shared unknowns."""

    @property
    def equations(self) -> NormalEquations:
        """At the minimum."""

    @property
    def print_error(self) -> PrintError:
        """By which the places are weighed."""

    @property
    def variance_factor(self) -> float:
        """sigma0 squared."""

    def board_residuals(self) -> BoardResiduals | None:
        """The points kept; None if the state is impossible."""

    def with_places(
        self, missed_mm: FloatArray, step: FloatArray, max_steps: int
    ) -> Self | FitFailure:
        """The minimum for points that miss their places by (P, 2), about a step (F + 6 V,) away."""

    def with_print_error(self, error: PrintError) -> Self:
        """The same with another weight of the places."""


S = TypeVar("S", bound=PrintSolution)

PRINT_ROUNDS = 30
PLACES_SETTLED = 1e-3
"""Of the places' standard deviation, what none moves by more."""
WEIGHT_SETTLED = 0.01
"""Of the weight of the places."""


def settle_print(solution: S, max_steps: int, *, is_held: bool = False) -> S | FitFailure:
    """Solve for the places of the print beside all else, if it is seen to err.

    The standard deviations of smooth and of other misses are estimated along, by restricted maximum
    likelihood (D. MacKay, "Bayesian interpolation", 1992), unless they are held.
    """
    for _ in range(PRINT_ROUNDS):
        error = solution.print_error
        found = solution.board_residuals() if error.is_seen else None
        if found is None:
            break
        equations = solution.equations
        gradient = np.concatenate([equations.shared_gradient, equations.pose_gradient.ravel()])
        try:
            eliminated = eliminate_print(equations, solution.basis, found, error)
            unknowns, step = eliminated.steps(gradient, pull_of_places(found, error))
            n_smooth, n_others = eliminated.n_told()
        except LinAlgError:
            break
        missed_mm = found.places_missed_mm + step
        again = solution.with_places(missed_mm, unknowns, max_steps)
        if isinstance(again, FitFailure):
            return again
        solution = again.with_print_error(replace(error, n_told=n_smooth + n_others))
        if not is_held:
            least_mm = LEAST_OF_TARGET * found.length_mm
            smooth = float(np.sum(np.einsum("pkf,pk->f", found.fields, missed_mm) ** 2))
            others = float(np.sum(missed_mm**2)) - smooth
            variance = max(others / max(n_others, 1e-3), least_mm**2)
            smooth /= max(n_smooth, 1e-3)
            told = PrintError(
                float(np.sqrt(variance)),
                solution.variance_factor / variance,
                max(1.0 - variance / max(smooth, 1e-300), 0.0),
                n_smooth + n_others,
            )
            solution = solution.with_print_error(told)
        now = solution.print_error
        rough = (1.0 - now.smooth_share) / (1.0 - error.smooth_share)
        change = np.log([now.weight / error.weight, rough])
        largest_mm = max(float(np.abs(missed_mm).max()), error.sigma_mm)
        is_still = np.abs(step[found.point]).max() < PLACES_SETTLED * largest_mm
        if is_still and np.abs(change).max() < WEIGHT_SETTLED:
            break
    return solution


def begin_print(solution: S, max_steps: int, widening: Callable[[S], float]) -> S | FitFailure:
    """Solve for the places of a print that was taken for right, if the views show that it errs.

    That residuals of a point agree between views shows it. What is smooth over the print is mostly
    taken up by camera and poses, and is looked for by an F test, over the ``widening`` of the
    points' variance where residuals of one view are alike: their mean over views is smooth, too.
    """
    found = solution.board_residuals()
    if found is None or len(np.unique(found.view)) < FEWEST_VIEWS:
        return solution
    error = seen_print_error(found, solution.variance_factor, widening(solution))
    if not error.is_seen:
        trial = smooth_trial(found, solution.variance_factor)
        tried = settle_print(solution.with_print_error(trial), max_steps, is_held=True)
        if isinstance(tried, FitFailure) or not _is_smooth(
            solution, tried, max(widening(solution), widening(tried))
        ):
            return solution
        error = trial
    return settle_print(solution.with_print_error(error), max_steps)


def _is_smooth(plain: S, tried: S, widening: float) -> bool:
    after = tried.board_residuals()
    if after is None or after.fields.shape[2] == 0:
        return False
    n_fields = after.fields.shape[2]
    freedom = 2 * len(after.point) - n_fields
    cost = tried.print_error.cost(after.places_missed_mm, after.fields)
    decrease = plain.equations.chi2 - tried.equations.chi2 - cost
    statistic = max(decrease, 0.0) / n_fields / (tried.variance_factor * widening)
    return bool(fdtrc(n_fields, freedom, statistic) < SMOOTH_P)


def smooth_trial(found: BoardResiduals, variance_factor: float) -> PrintError:
    """Of a print that errs smoothly alone, by as much as prints do, to look for that."""
    least_mm = LEAST_OF_TARGET * found.length_mm
    smooth = found.n_points * (FIRST_OF_TARGET * found.length_mm) ** 2
    return PrintError(least_mm, variance_factor / least_mm**2, 1.0 - least_mm**2 / smooth)


_TURNED_SIGMAS = 2.0
"""Agreement, over the root of the count of views, that no choice of numberings makes of chance: the
best choice makes 1.1 of it."""
_ROUNDS_OF_TURNS = 10


def missed_places_mm(
    camera: CameraModel, pose: Pose[Any, Board], board_mm: FloatArray, residuals_px: FloatArray
) -> FloatArray:
    """(M, 2) what points (M, 3) of a board miss their places by, along its axes."""
    _, by_point, _ = camera.project_with_jacobian(pose.apply(board_mm))
    by_board = by_point @ pose.rotation[:, :2]
    return np.asarray(np.linalg.solve(by_board, residuals_px[:, :, None])[:, :, 0])


def agreeing_numberings(
    places_mm: Sequence[FloatArray], missed_mm: Sequence[FloatArray], known: Sequence[Numbering]
) -> IntArray | None:
    """Which numbering each view has of a target that looks alike when turned.

    Errors of its print turn with it: where views are numbered alike, points miss their places
    alike. It is told by all views together, and must be clearer than chance can make it.

    ``places_mm`` (M, 3) are the points of each of V views as found numbered, ``missed_mm`` (M, 2)
    what each misses its place by; ``known`` are numberings that no single view can tell apart, the
    one as found first. The numbers (V,) among these leave the first view its own. None where the
    views tell nothing, or all are numbered alike.
    """
    if len(known) < 2 or len(places_mm) < FEWEST_VIEWS:
        return None
    turned = [
        [numbering.new_from_found.apply(places)[:, :2] for numbering in known]
        for places in places_mm
    ]
    every = np.rint(np.concatenate([p for view in turned for p in view]) / SAME_POINT_MM)
    number = np.unique(every.astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    n_points = int(number.max()) + 1
    lengths = [len(places) for places in places_mm for _ in known]
    patterns = np.zeros((len(places_mm), len(known), n_points, 2))
    for k, of in enumerate(np.split(number, np.cumsum(lengths)[:-1])):
        view, turn = divmod(k, len(known))
        rotation = known[turn].new_from_found.rotation[:2, :2]
        patterns[view, turn, of] = missed_mm[view] @ rotation.T
    chosen = _most_alike(patterns)
    own = patterns[np.arange(len(chosen)), chosen]
    total, squares = own.sum(axis=0), np.sum(own**2)
    agreement = float(np.sum(total**2) - squares)
    scatter = float(squares) / (2.0 * sum(len(places) for places in places_mm))
    seen = (own**2).sum(axis=2) > 0.0
    pairs = float(np.sum(seen.sum(axis=0) * (seen.sum(axis=0) - 1.0)))
    least = SIGNIFICANT_SIGMAS + _TURNED_SIGMAS * np.sqrt(len(chosen))
    if not chosen.any() or not agreement > least * 2.0 * scatter * np.sqrt(pairs):
        return None
    return chosen


def _most_alike(patterns: FloatArray) -> IntArray:
    """Choice (V,) among K patterns (V, K, P, 2) of each view such that their sum is the longest."""
    every = np.arange(len(patterns))
    chosen = np.zeros(len(patterns), dtype=np.int64)
    total = patterns[0, 0].copy()
    for view in every[1:]:
        chosen[view] = int(np.argmax(np.sum(patterns[view] * total, axis=(1, 2))))
        total += patterns[view, chosen[view]]
    for _ in range(_ROUNDS_OF_TURNS):
        before = chosen.copy()
        for view in every[1:]:
            total -= patterns[view, chosen[view]]
            chosen[view] = int(np.argmax(np.sum(patterns[view] * total, axis=(1, 2))))
            total += patterns[view, chosen[view]]
        if np.array_equal(before, chosen):
            break
    return chosen
