# SPDX-License-Identifier: Apache-2.0
"""The two cameras of a drawn instrument calibrated together, judged against the truth."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoPair
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.calibration.cameras.stereo_result import reasons_to_refuse as stereo_reasons
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.target import Chessboard, CircleGrid, Target
from rigs.instrument_bounds import SeenPoints, bound, camera_information, moved_head
from rigs.instrument_stages import HOPELESS_FOCAL, Outcome, judged, views_of
from rigs.instruments import DEGENERATE, Instrument, board_placements

GROUPS = {
    "left": tuple(range(9)),
    "right": tuple(range(9, 18)),
    "turn": (18, 19, 20),
    "base": (21, 22, 23),
}


def target_of(made: Instrument) -> Target:
    """The target as it is stated."""
    kind = Chessboard if made.target.kind == "chessboard" else CircleGrid
    return kind(made.target.columns, made.target.rows, made.target.pitch_mm)


def run_stereo(made: Instrument) -> Outcome:
    """Calibrate both cameras from pairs of one board."""
    n = 2 if made.fault in ("two pairs", "two views") else made.n_views
    places = board_placements(made, made.rng(5), n, for_sheets=False)
    left, right = (views_of(made, places, side, 5) for side in (0, 1))
    pairs = [StereoPair(a, b) for a, b in zip(left.found, right.found, strict=True)]
    if made.fault == "pairs shuffled":
        order = made.rng(6).permutation(len(pairs))
        pairs = [StereoPair(a, right.found[k]) for a, k in zip(left.found, order, strict=True)]
    begun = time.process_time()
    try:
        fit = calibrate_stereo(pairs, target_of(made))
    except ArmscanError as error:
        fit = FitFailure(str(error))
    seconds = time.process_time() - begun
    seen = [*left.seen, *right.seen]
    best = bound(camera_information(made, seen, 24), 24)
    sigma = np.sqrt(np.diag(best))
    focal = max(
        float((sigma[:2] / made.left.focal).max()),
        float((sigma[9:11] / made.left.focal).max()),
    )
    is_degenerate = made.fault in DEGENERATE["stereo"] + DEGENERATE["camera"]
    is_hopeless = is_degenerate or len(places) < 3 or focal > HOPELESS_FOCAL
    reasons = (fit.reason,) if isinstance(fit, FitFailure) else stereo_reasons(fit)
    if reasons or isinstance(fit, FitFailure):
        result = "rightly refused" if is_hopeless else "wrongly refused"
        return Outcome("stereo", result, reasons[0], seconds=seconds)
    error = stereo_error(made, fit)
    free = np.flatnonzero(np.diag(fit.covariance) > 0.0)
    covariance = between(made, error, fit.covariance, seen)[np.ix_(free, free)]
    groups = {
        name: [list(free).index(k) for k in rows if k in free] for name, rows in GROUPS.items()
    }
    ratio = np.sqrt(np.diag(covariance) / np.diag(best)[free])
    return judged(
        "stereo",
        error[free],
        covariance,
        groups,
        over_bound=float(np.exp(np.log(ratio).mean())),
        warnings=fit.warnings,
        seconds=seconds,
    )


def between(
    made: Instrument, error: FloatArray, covariance: FloatArray, seen: Sequence[SeenPoints]
) -> FloatArray:
    """(24, 24) covariance that is stated at the estimate, carried halfway to the truth.

    Which shifts of both images one sees best, to a thousandth of what each centre is known to,
    turns with centres and turn themselves: across an error of two sigmas of these by more than that
    thousandth. Linear in the middle, the chord is exact to the third order. Cramer-Rao bounds at
    both places tell how the covariance changes: ``L2 L1^-1 C L1^-T L2'`` of their roots.
    """
    roots = [
        np.linalg.cholesky(bound(camera_information(moved_head(made, part * error), seen, 24), 24))
        for part in (1.0, 0.5)
    ]
    change = roots[1] @ np.linalg.inv(roots[0])
    return np.asarray(change @ covariance @ change.T)


def stereo_error(made: Instrument, fit: StereoFit) -> FloatArray:
    """(24,) of left, right, turn and shift of the right camera."""
    assert made.right is not None
    assert made.right_from_left is not None
    pose = fit.views.right_from_left
    turn = Rotation.from_matrix(pose.rotation @ made.right_from_left.rotation.T).as_rotvec()
    return np.concatenate(
        [
            fit.views.left.parameters - made.left.parameters,
            fit.views.right.parameters - made.right.parameters,
            turn,
            pose.translation_mm - made.right_from_left.shift,
        ]
    )
