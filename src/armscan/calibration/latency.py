# SPDX-License-Identifier: Apache-2.0
"""The time between the camera's clock and the arm's, from a moving stand-off over a flat plate.

While the head comes nearer and goes away, a wrong time places the plate too high on the way down
and too low on the way up: height error = stand-off speed x time error. The plate is estimated
along. What depends on where the head is (flatness, lever, scale) repeats on the way back with the
same sign and does not look like time, but only if the motion reverses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.residual_noise import (
    NoiseCovariance,
    ResidualNoise,
    likeliest_noise,
    score_sigma,
)
from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, floats, ints
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.least_squares import huber_weights, robust_sigma
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.reconstruction.sync import largest_gap_ns, poses_at
from armscan.records.recording import ArmTrack

SEARCHED_NS = 300_000_000
"""Clocks that are said to be shared differ by less."""
MOST_SEARCHED_NS = 1_800_000_000_000
"""Of separate clocks; that takes minutes."""
SEARCH_STEP_NS = 4_000_000
"""A hand reverses in 0.1 s at the fastest: its speed hardly changes meanwhile."""
INSTRUMENT_NS = 20_000_000
"""Speeds are taken over twice as long, by samples that the pose itself does not rest on: the arm's
noise would else make times in the middle between two samples look best."""
FEWEST_EXPOSURES = 60
FEWEST_REVERSALS = 4
SLOWEST_MM_S = 5.0
"""A lag of the arm of 0.001 mm is 200 us at this speed."""
LEAST_ASIDE_MM = 1.0
"""The stripes must cover so much of the plate on either side, rms, for its tilt to be known."""
LARGEST_SIGMA_NS = 200_000.0
FARTHEST = 5.0
"""Exposures off by more sigmas have something else under the stripe."""
TRIMMED = 4.0
SECOND_AXIS_MM = 2.0
"""Stripes that spread by so much in a second direction, rms, show it."""
SECOND_BEST = 2.0
"""Another time whose misfit is less than so many times the best one makes the result ambiguous."""
STEPS, SETTLED_NS = 20, 50.0
MOVE = "move the head nearer and away by 10 mm or more, once a second, for 10 s"
ODD_SIGMAS, SMALLEST_DRIFT = 4.0, 5e-6
MANY_OUT, ROUGH_MM = 0.1, 0.1
TERM_MM, N_TERMS = 20.0, 7
"""Errors that depend on the place are taken as quadratic over what a hand scans, scaled by this."""
UNEVEN = ("z", "zz", "xz", "yz", "xx", "xy", "yy")
LEAN_NAMES = ("lean_1_mm", "lean_2_mm")
"""Of the stripes' axes on the plate, which a turn of the hand-eye leaves."""
PLATE_NAMES = ("tilt_1_rad", "tilt_2_rad", "height_mm", *(f"uneven_{one}_mm" for one in UNEVEN))


class PlateLooks(RowRecord):
    """What N exposures see of the plate, in the Sensor frame.

    Parameters
    ----------
    t_ns
        (N,) mid-exposure by the camera's clock, increasing.
    centre_mm
        (N, 3) mean of the stripes' points.
    axes_mm
        (N, 2, 3) the directions in which they spread most, each as long as their rms along it;
        the second is zero where one straight stripe was seen.
    """

    t_ns: IntArray = ints("N")
    centre_mm: FloatArray = floats("N", 3)
    axes_mm: FloatArray = floats("N", 2, 3)


def look_at_plate(points_mm: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Centre (3,) and axes (2, 3) of one exposure's points (M, 3); None if they are no stripe."""
    points = np.asarray(points_mm, dtype=np.float64)
    for _ in range(3):
        if len(points) < 20:
            return None
        centre = points.mean(axis=0)
        _, values, axes = np.linalg.svd(points - centre, full_matrices=False)
        rms = values / np.sqrt(len(points))
        n_axes = 2 if rms[1] > SECOND_AXIS_MM else 1
        off = np.linalg.norm((points - centre) @ axes[n_axes:].T, axis=1)
        is_near = off <= TRIMMED * robust_sigma(off)
        if is_near.all():
            break
        points = points[is_near]
    lengths = np.where(np.arange(2) < n_axes, rms[:2], 0.0)
    # the sign of an axis is free; along x or y it stays the same from exposure to exposure
    signs = np.sign(axes[np.arange(2), np.abs(axes[:2]).argmax(axis=1)])
    return centre, axes[:2] * (signs * lengths)[:, None]


def plate_looks(t_ns: Sequence[int], points_mm: Sequence[FloatArray]) -> PlateLooks:
    """Summarise exposures: one time and points (M, 3) in Sensor each; poor ones are left out."""
    found = [(t, look_at_plate(points)) for t, points in zip(t_ns, points_mm, strict=True)]
    kept = [(t, *look) for t, look in found if look is not None]
    kept.sort(key=lambda item: item[0])
    n = len(kept)
    return PlateLooks(
        t_ns=np.array([item[0] for item in kept], dtype=np.int64),
        centre_mm=np.array([item[1] for item in kept]).reshape(n, 3),
        axes_mm=np.array([item[2] for item in kept]).reshape(n, 2, 3),
    )


@dataclass(frozen=True, slots=True)
class StandOffMotion:
    """What the motion tells.

    Parameters
    ----------
    speed_mm_s
        Root mean square speed along the plate's normal.
    telling_mm_s
        What is left of it beyond what the plate's place, errors that depend on the place, and a
        drift where it is estimated, explain as well.
    n_reversals
        How often the head turned from coming nearer to going away or back.
    seconds
        From the first exposure to the last.
    """

    speed_mm_s: float
    telling_mm_s: float
    n_reversals: int
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class LatencyFit:
    """The time to add to an exposure's time before the arm's pose is looked up.

    Parameters
    ----------
    estimate
        Value: the time in whole ns at ``t_middle_ns``. Parameters: ``latency_ns``, ``drift`` for
        separate clocks, two tilts of the plate in rad, its height in mm, and what depends on
        stand-off z and place x, y, per `TERM_MM`. Residuals (K,): heights over that fit, mm.
    t_middle_ns
        Camera's time for which the latency holds; elsewhere the drift adds to it.
    drift
        Part by which the arm's clock runs faster; of shared clocks a check only.
    sigma_drift
        Its standard deviation.
    t_ns
        (K,) times of the exposures used.
    before_t_ns, before_mm
        (L,) heights over the same plate with the latency at 0, or at the coarse search's for
        separate clocks, of those that then have a pose.
    n_left_out
        Exposures that do not fit the plate, or had no pose.
    """

    estimate: Estimate[int]
    t_middle_ns: int
    drift: float
    sigma_drift: float
    t_ns: IntArray
    before_t_ns: IntArray
    before_mm: FloatArray
    motion: StandOffMotion
    noise: tuple[ResidualNoise, ...]
    n_left_out: int
    warnings: tuple[str, ...] = ()

    @property
    def latency_ns(self) -> int:
        """Of the estimate."""
        return self.estimate.value

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the latency."""
        return float(self.estimate.sigma[0])


@dataclass(frozen=True, slots=True)
class _State:
    """Time at the middle, drift, plate ``normal . p = height + uneven . terms``, leans of axes."""

    shift_ns: int
    drift: float
    normal: FloatArray
    height_mm: float
    uneven_mm: FloatArray
    leans_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """Exposures with a pose: rows; centre, sensor (K, 3) and axes (K, 2, 3) in Base."""

    rows: IntArray
    sensor_mm: FloatArray
    centre_mm: FloatArray
    axes_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The looks and the sensor's origin in Tool, and the arm's track."""

    t_ns: IntArray
    sensor_mm: FloatArray
    centre_mm: FloatArray
    axes_mm: FloatArray
    arm: ArmTrack
    max_gap_ns: int
    has_drift: bool

    @property
    def t_middle_ns(self) -> int:
        return int(self.t_ns[0] + (self.t_ns[-1] - self.t_ns[0]) // 2)

    @property
    def since_ns(self) -> FloatArray:
        return np.asarray((self.t_ns - self.t_middle_ns).astype(np.float64))

    def place(self, shift_ns: int, drift: float = 0.0) -> _Placed:
        """All looks that have a pose at this time."""
        times = self.t_ns + shift_ns + np.rint(drift * self.since_ns).astype(np.int64)
        poses = poses_at(times, self.arm, max_gap_ns=self.max_gap_ns)
        has = np.flatnonzero(poses.has_pose)
        turn = poses.rotations[has]
        centre = np.einsum("nij,nj->ni", turn, self.centre_mm[has]) + poses.translations_mm[has]
        axes = np.einsum("nij,nkj->nki", turn, self.axes_mm[has])
        sensor = turn @ self.sensor_mm + poses.translations_mm[has]
        return _Placed(has, sensor, centre, axes)


def calibrate_latency(
    looks: PlateLooks,
    arm: ArmTrack,
    tool_from_sensor: Pose[Tool, Sensor],
    *,
    is_shared: bool = True,
) -> LatencyFit | FitFailure:
    """Estimate the latency, and the drift where the clocks are separate.

    A search over time finds where the plate is flattest; Gauss-Newton with instruments then solves
    time and plate together. Residuals scatter independently and slowly (an Ornstein-Uhlenbeck
    process), as restricted maximum likelihood says; exposures off by more than `FARTHEST` sigmas
    are left out.

    Unless ``is_shared``, camera and arm have clocks of their own: any offset is searched for that
    lets the exposures lie within the track, and the drift is estimated.
    """
    if len(looks) < FEWEST_EXPOSURES:
        return FitFailure(
            f"{len(looks)} exposures show a stripe on the plate; {FEWEST_EXPOSURES} are needed",
            "record 10 s over the plate",
        )
    problem = _problem(looks, arm, tool_from_sensor, has_drift=not is_shared)
    start = _search(problem, is_shared)
    if isinstance(start, FitFailure):
        return start
    kept = np.ones(len(looks), dtype=np.bool_)
    rough = _solve(problem, start, kept)
    while not isinstance(rough, FitFailure):
        is_far = rough.system.is_far()
        if not is_far.any():
            break
        kept[rough.system.rows[is_far]] = False
        rough = _solve(problem, rough.state, kept)
    if isinstance(rough, FitFailure):
        return rough
    motion = rough.system.motion
    refused = _refused(motion)
    if refused is not None:
        return refused
    fine = _solve(problem, rough.state, kept, rough.system.noise())
    if isinstance(fine, FitFailure):
        return fine
    return _result(problem, fine, 0 if is_shared else start.shift_ns)


def _problem(
    looks: PlateLooks, arm: ArmTrack, tool_from_sensor: Pose[Tool, Sensor], *, has_drift: bool
) -> _Problem:
    if (np.diff(looks.t_ns) <= 0).any():
        raise InputError("times of the looks at the plate do not increase")
    n_axes = 2 if np.median(np.linalg.norm(looks.axes_mm[:, 1], axis=1)) > 0.0 else 1
    return _Problem(
        t_ns=looks.t_ns,
        sensor_mm=tool_from_sensor.translation_mm,
        centre_mm=tool_from_sensor.apply(looks.centre_mm),
        axes_mm=tool_from_sensor.rotate(looks.axes_mm[:, :n_axes]),
        arm=arm,
        max_gap_ns=largest_gap_ns(arm),
        has_drift=has_drift,
    )


def _search(problem: _Problem, is_shared: bool) -> _State | FitFailure:
    """The time at which the plate is flattest, over all that may be."""
    if is_shared:
        low, high = -SEARCHED_NS, SEARCHED_NS
    else:
        span = int(problem.t_ns[-1] - problem.t_ns[0])
        low = int(problem.arm.t_ns[0] - problem.t_ns[0]) - span // 4
        high = int(problem.arm.t_ns[-1] - problem.t_ns[-1]) + span // 4
    if high - low > MOST_SEARCHED_NS:
        return FitFailure(
            f"{(high - low) * 1e-9:.0f} s are too long to be searched for the clocks' difference",
            f"give the arm's samples of {MOST_SEARCHED_NS * 1e-9:.0f} s about the exposures",
        )
    shifts = np.arange(low, high + 1, SEARCH_STEP_NS).tolist()
    tried = [(_flatness(problem.place(shift), len(problem.t_ns)), shift) for shift in shifts]
    if not tried or min(tried)[0] == np.inf:
        return FitFailure(
            "at no time between the clocks do most exposures lie within the arm's track",
            "let the arm record before the camera starts and after it stops",
        )
    best, shift = min(tried)
    beside = tried[max(shifts.index(shift) - 1, 0) :][:3]
    if len(beside) < 3 or max(beside)[0] == np.inf or beside[1][1] != shift:
        return FitFailure(
            f"the plate is flattest {shift * 1e-6:.0f} ms off, where the search ends",
            "say that the clocks are separate, if they are; else let the arm record for longer",
        )
    far = [(misfit, at) for misfit, at in tried if abs(at - shift) > 0.1e9]
    # of a rough minimum between two steps the misfit is the way of half a step
    if far and min(far)[0] < SECOND_BEST * (best + 0.02):
        return FitFailure(
            f"the plate is as flat with {min(far)[1] / 1e6:.0f} ms between the clocks "
            f"({min(far)[0]:.3g} mm rms) as with {shift / 1e6:.0f} ms ({best:.3g} mm)",
            "move the head nearer and away by 10 mm or more, unevenly, once a second or faster",
        )
    placed = problem.place(shift)
    middle, axes, _ = _plate(placed)
    state = _State(shift, 0.0, axes[2], float(axes[2] @ middle), np.zeros(N_TERMS), np.zeros(2))
    spread = (placed.centre_mm - middle) @ axes[:2].T
    aside = np.vstack([spread, *(one @ axes[:2].T for one in placed.axes_mm.swapaxes(0, 1))])
    narrow = float(np.linalg.svd(aside, compute_uv=False)[1] / np.sqrt(len(spread)))
    if narrow < LEAST_ASIDE_MM:
        return FitFailure(
            f"the stripes cover only {narrow:.2g} mm of the plate to the side, rms",
            "move the head sideways by some 20 mm meanwhile",
        )
    return state


def _plate(placed: _Placed) -> tuple[FloatArray, FloatArray, float]:
    """Middle, axes (normal last) and rms distance of a plane through centres and axes' ends."""
    middle = placed.centre_mm.mean(axis=0)
    about = [placed.centre_mm - middle, *placed.axes_mm.swapaxes(0, 1)]
    values, vectors = np.linalg.eigh(sum(part.T @ part for part in about))
    return middle, vectors.T[::-1], float(np.sqrt(max(values[0], 0.0) / len(placed.rows)))


def _flatness(placed: _Placed, n: int) -> float:
    """Rms distance from a plane in mm; infinite where less than 3 of 4 exposures have a pose."""
    if len(placed.rows) < max(0.75 * n, FEWEST_EXPOSURES):
        return np.inf
    return _plate(placed)[2]


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The problem at a state, of K exposures: kinds of residuals are heights, then leans.

    Parameters
    ----------
    rows, seconds
        (K,) exposures used, and their times.
    residuals
        (K,) of each kind, in mm.
    jacobians
        (K, P) of each kind by latency in ns, drift, two tilts in rad, height in mm.
    names
        (P,) of the parameters.
    """

    rows: IntArray
    seconds: FloatArray
    residuals: tuple[FloatArray, ...]
    jacobians: tuple[FloatArray, ...]
    names: tuple[str, ...]

    def is_far(self) -> BoolArray:
        """(K,) True for exposures that do not fit the plate."""
        far = [np.abs(part) > FARTHEST * max(robust_sigma(part), 1e-9) for part in self.residuals]
        return np.asarray(np.any(far, axis=0))

    def noise(self) -> tuple[ResidualNoise, ...]:
        """Of each kind, by restricted maximum likelihood."""
        return tuple(
            likeliest_noise(part, jacobian, self.seconds)
            for part, jacobian in zip(self.residuals, self.jacobians, strict=True)
        )

    @property
    def motion(self) -> StandOffMotion:
        """What the heights tell of time."""
        speed = self.jacobians[0][:, 0] * 1e9
        others = self.jacobians[0][:, 1:]
        others = others / np.maximum(np.abs(others).max(axis=0), 1e-30)
        telling = speed - others @ np.linalg.lstsq(others, speed, rcond=None)[0]
        turned = speed[np.abs(speed) > 0.3 * speed.std()]
        return StandOffMotion(
            speed_mm_s=float(np.sqrt((speed**2).mean())),
            telling_mm_s=float(np.sqrt((telling**2).mean())),
            n_reversals=int((np.diff(np.sign(turned)) != 0).sum()),
            seconds=float(self.seconds[-1] - self.seconds[0]),
        )

    def solve(
        self, noise: tuple[ResidualNoise, ...] | None
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """Step (P,), its covariance (P, P) and chi2; None where the parameters mix."""
        scale = np.max([np.abs(one).max(axis=0) for one in self.jacobians], axis=0)
        scale = np.where(scale > 0.0, scale, 1.0)
        matrix, target, chi2 = np.zeros((len(scale), len(scale))), np.zeros(len(scale)), 0.0
        for k, (part, jacobian) in enumerate(zip(self.residuals, self.jacobians, strict=True)):
            if noise is None:
                sigma = max(robust_sigma(part), 1e-9)
                weights = huber_weights(part / sigma) / sigma**2
                weighed, against = weights[:, None] * (jacobian / scale), weights * part
            else:
                inverse = NoiseCovariance(noise[k], self.seconds)
                weighed, against = inverse.solve(jacobian / scale), inverse.solve(part)
            matrix += weighed.T @ (jacobian / scale)
            target -= weighed.T @ part
            chi2 += float(part @ against)
        values, vectors = np.linalg.eigh(matrix)
        if values[0] <= 1e-10 * values[-1]:
            return None
        covariance = (vectors / values) @ vectors.T
        return covariance @ target / scale, covariance / np.outer(scale, scale), chi2


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Where the iteration ended."""

    state: _State
    system: _System
    covariance: FloatArray
    chi2: float
    noise: tuple[ResidualNoise, ...]


def _linearise(problem: _Problem, state: _State, kept: BoolArray) -> tuple[_System, FloatArray]:
    """The system at a state and the middle (3,) about which the plate tilts."""
    lag = max(INSTRUMENT_NS, 2 * int(np.median(np.diff(problem.arm.t_ns))))
    placed = [problem.place(state.shift_ns + step, state.drift) for step in (0, lag, -lag)]
    has_all = [np.isin(np.arange(len(kept)), one.rows) for one in placed]
    rows = np.flatnonzero(np.all([kept, *has_all], axis=0))
    at = [np.searchsorted(one.rows, rows) for one in placed]
    centres = [one.centre_mm[index] for one, index in zip(placed, at, strict=True)]
    axes = [one.axes_mm[index] for one, index in zip(placed, at, strict=True)]
    middle = centres[0].mean(axis=0) if len(rows) else np.zeros(3)
    across = _across(state.normal)
    stand_off = (placed[0].sensor_mm[at[0]] - centres[0]) @ state.normal
    terms = _terms((centres[0] - middle) @ across.T, stand_off)
    residuals, jacobians, n_axes = [], [], problem.axes_mm.shape[1]
    for k in range(-1, n_axes):
        now, ahead, behind = centres if k < 0 else [one[:, k] for one in axes]
        by_time = (ahead - behind) @ state.normal / (2.0 * lag)
        by_drift = [by_time * problem.since_ns[rows]] if problem.has_drift else []
        by_tilt = ((now - middle) if k < 0 else now) @ across.T
        by_plate = np.column_stack([np.ones(len(rows)), terms]) * (-1.0 if k < 0 else 0.0)
        by_lean = np.zeros((len(rows), 2))
        by_lean[:, max(k, 0)] = 0.0 if k < 0 else -1.0
        plate = state.height_mm + terms @ state.uneven_mm if k < 0 else state.leans_mm[k]
        residuals.append(now @ state.normal - plate)
        jacobians.append(
            np.column_stack([by_time, *by_drift, by_tilt, by_plate, by_lean[:, :n_axes]])
        )
    names = (
        "latency_ns",
        *(["drift"] if problem.has_drift else []),
        *PLATE_NAMES,
        *LEAN_NAMES[:n_axes],
    )
    seconds = 1e-9 * problem.since_ns[rows]
    return _System(rows, seconds, tuple(residuals), tuple(jacobians), names), middle


def _across(normal: FloatArray) -> FloatArray:
    """(2, 3) two directions in the plate, that turn with its normal without a leap."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _terms(aside_mm: FloatArray, stand_off_mm: FloatArray) -> FloatArray:
    """(K, 7) what depends smoothly on the place: scale, unevenness and the arm's own errors."""
    x, y = aside_mm.T / TERM_MM
    z = (stand_off_mm - stand_off_mm.mean()) / TERM_MM
    return np.column_stack([z, z * z, x * z, y * z, x * x, x * y, y * y])


def _solve(
    problem: _Problem,
    start: _State,
    kept: BoolArray,
    noise: tuple[ResidualNoise, ...] | None = None,
) -> _Solution | FitFailure:
    """Iterate from a start; each kind of residual has its robust sigma if the noise is None."""
    state, reason = start, f"the time between the clocks did not settle within {STEPS} steps"
    for _ in range(STEPS):
        system, middle = _linearise(problem, state, kept)
        if len(system.rows) < FEWEST_EXPOSURES:
            return FitFailure(
                f"{len(system.rows)} exposures have a pose and fit the plate; "
                f"{FEWEST_EXPOSURES} are needed",
                "record 10 s over the plate, the arm before the camera",
            )
        found = system.solve(noise)
        if found is None:
            reason = "time and plate cannot be told apart"
            break
        step, covariance, chi2 = found
        if abs(step[0]) < max(SETTLED_NS, 0.01 * np.sqrt(covariance[0, 0])):
            return _Solution(state, system, covariance, chi2, noise or ())
        state = _after(problem, state, step, middle)
    refused = _refused(system.motion)
    return FitFailure(reason, MOVE) if refused is None else refused


def _after(problem: _Problem, state: _State, step: FloatArray, middle: FloatArray) -> _State:
    drift = float(step[1]) if problem.has_drift else 0.0
    first, n_axes = 2 if problem.has_drift else 1, problem.axes_mm.shape[1]
    by_tilt, by_plate = step[first : first + 2], step[first + 2 : first + 3 + N_TERMS]
    by_lean = np.append(step[-n_axes:], np.zeros(2 - n_axes))
    tilted = state.normal + by_tilt @ _across(state.normal)
    normal = tilted / np.linalg.norm(tilted)
    above = state.height_mm - float(state.normal @ middle)
    return _State(
        shift_ns=state.shift_ns + round(float(step[0])),
        drift=state.drift + drift,
        normal=normal,
        height_mm=float(normal @ middle) + above + float(by_plate[0]),
        uneven_mm=state.uneven_mm + by_plate[1:],
        leans_mm=state.leans_mm + by_lean,
    )


def _refused(motion: StandOffMotion) -> FitFailure | None:
    """Why the motion does not tell the time; None if it does."""
    told = (
        f"the stand-off moved at {motion.speed_mm_s:.3g} mm/s rms for {motion.seconds:.3g} s and "
        f"reversed {motion.n_reversals} times; beyond what the plate and smooth errors of the "
        f"place explain as well, {motion.telling_mm_s:.3g} mm/s are left"
    )
    if motion.n_reversals < FEWEST_REVERSALS:
        return FitFailure(f"{told}; {FEWEST_REVERSALS} reversals are needed", MOVE)
    if motion.telling_mm_s < SLOWEST_MM_S:
        return FitFailure(f"{told}; {SLOWEST_MM_S:g} are needed", MOVE)
    return None


def _result(problem: _Problem, fine: _Solution, before_ns: int) -> LatencyFit | FitFailure:
    motion, system = fine.system.motion, fine.system
    covariance = _widened(fine, motion)
    sigma_ns = float(np.sqrt(covariance[0, 0]))
    refused = _refused(motion)
    if refused is not None:
        return refused
    if sigma_ns > LARGEST_SIGMA_NS:
        return FitFailure(
            f"the time between the clocks has a sigma of {sigma_ns / 1e3:.0f} us, more than "
            f"{LARGEST_SIGMA_NS / 1e3:.0f}: heights scatter by "
            f"{float(np.std(system.residuals[0])):.2g} mm, the stand-off moved at "
            f"{motion.telling_mm_s:.3g} mm/s rms for {motion.seconds:.3g} s",
            "move faster or longer",
        )
    drift, sigma_drift = fine.state.drift, 0.0
    if problem.has_drift:
        sigma_drift = float(np.sqrt(covariance[1, 1]))
    else:
        drift, sigma_drift = _drift_left(system, fine.noise)
    kept = np.zeros(len(problem.t_ns), dtype=np.bool_)
    kept[system.rows] = True
    earlier = _linearise(problem, replace(fine.state, shift_ns=before_ns, drift=0.0), kept)[0]
    return LatencyFit(
        estimate=Estimate(
            value=fine.state.shift_ns,
            parameter_names=system.names,
            covariance=covariance,
            residuals=system.residuals[0],
            degrees_of_freedom=sum(map(len, system.residuals)) - len(system.names),
            chi2=fine.chi2,
        ),
        t_middle_ns=problem.t_middle_ns,
        drift=drift,
        sigma_drift=sigma_drift,
        t_ns=problem.t_ns[system.rows],
        before_t_ns=problem.t_ns[earlier.rows],
        before_mm=earlier.residuals[0],
        motion=motion,
        noise=fine.noise,
        n_left_out=len(problem.t_ns) - len(system.rows),
        warnings=_warnings(problem, fine, drift, sigma_drift),
    )


def _widened(fine: _Solution, motion: StandOffMotion) -> FloatArray:
    """(P, P) covariance in which time and drift scatter as their scores do, if that is more.

    What depends on the place follows the motion's own rhythm, where the slow process has little:
    scores are correlated over the time between two reversals.
    """
    system, factors = fine.system, np.ones(len(fine.covariance))
    lag = max(len(system.rows) // max(motion.n_reversals, 1), 1)
    for k in range(2 if "drift" in system.names else 1):
        scores = np.zeros(len(system.rows))
        for noise, part, jacobian in zip(
            fine.noise, system.residuals, system.jacobians, strict=True
        ):
            inverse = NoiseCovariance(noise, system.seconds)
            scores += inverse.solve(jacobian @ fine.covariance[k]) * part
        factors[k] = max(1.0, score_sigma(scores, lag) / float(np.sqrt(fine.covariance[k, k])))
    return np.asarray(fine.covariance * np.outer(factors, factors))


def _drift_left(system: _System, noise: tuple[ResidualNoise, ...]) -> tuple[float, float]:
    """The drift that shared clocks seem to have, and its sigma: a check of their being shared."""
    ns = 1e9 * system.seconds
    widened = _System(
        system.rows,
        system.seconds,
        system.residuals,
        tuple(
            np.column_stack([one[:, :1], one[:, 0] * ns, one[:, 1:]]) for one in system.jacobians
        ),
        system.names,
    )
    found = widened.solve(noise)
    if found is None:
        return 0.0, np.inf
    return float(found[0][1]), float(np.sqrt(found[1][1, 1]))


def _warnings(
    problem: _Problem, fine: _Solution, drift: float, sigma_drift: float
) -> tuple[str, ...]:
    warnings = []
    n_out = len(problem.t_ns) - len(fine.system.rows)
    if n_out > MANY_OUT * len(problem.t_ns):
        warnings.append(
            f"{n_out} of {len(problem.t_ns)} exposures have no pose or do not fit the plate: "
            "it should fill the view, and no exposure lie before or after the arm's track"
        )
    if not problem.has_drift and abs(drift) > max(ODD_SIGMAS * sigma_drift, SMALLEST_DRIFT):
        warnings.append(
            f"the clocks are said to be shared but drift by {drift * 1e6:.0f} +- "
            f"{sigma_drift * 1e6:.0f} ppm: the latency holds for the middle of this recording only"
        )
    rough = float(robust_sigma(fine.system.residuals[0]))
    if rough > ROUGH_MM:
        warnings.append(
            f"heights of the plate scatter by {rough:.2g} mm: is it flat, and are sensor and "
            "hand-eye those of this head?"
        )
    return tuple(warnings)
