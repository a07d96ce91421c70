# SPDX-License-Identifier: Apache-2.0
"""The hand-eye from stripes on a flat plate: the thesis's method at its statistical best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.alternatives import find_alternatives
from armscan.calibration.hand_eye.conditioning import (
    conditioning_warnings,
    describe_conditioning,
    refuse_few_postures,
    refuse_open_hand_eye,
)
from armscan.calibration.hand_eye.contradictions import find_contradiction, plane_in_words
from armscan.calibration.hand_eye.least_squares import design
from armscan.calibration.hand_eye.left_out import leave_each_out
from armscan.calibration.hand_eye.mirrors import find_mirror
from armscan.calibration.hand_eye.noise_model import noise_components, total_covariance
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_checks import (
    agreement_warnings,
    explain_misfit,
    influence_warnings,
    point_warnings,
    refuse_scatter,
)
from armscan.calibration.hand_eye.plate_fit import (
    PlateFit,
    fit_plate,
    hand_eye_information,
    hold_sensor,
    plane_after,
)
from armscan.calibration.hand_eye.plate_nodes import PlateNodes, condense, straight_stripes
from armscan.calibration.hand_eye.plate_outliers import CheckedFit, fit_without_wrong_postures
from armscan.calibration.hand_eye.plate_residuals import PlateState, place_nodes, shifted_plane
from armscan.calibration.hand_eye.plate_result import (
    hand_eye_calibration,
    posture_results,
    reference_facts,
    sigma_of,
    stripe_residuals,
)
from armscan.calibration.hand_eye.plate_rivals import settle_rivals
from armscan.calibration.hand_eye.plate_search import Start, find_start
from armscan.calibration.hand_eye.posture_geometry import REMEDY, common_to_postures
from armscan.calibration.hand_eye.posture_names import check_postures
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

AS_WELL = 1.5
"""What moved explains all postures if it leaves no more than this times the scatter of the arm that
is left without the postures that look wrong."""


def calibrate_on_plate(
    stripes: Sequence[PosedStripe],
    plate: PlateReference,
    options: HandEyeOptions | None = None,
    *,
    sensor_covariance: FloatArray | None = None,
) -> HandEyeFit | FitFailure:
    """Find where the sensor sits on the arm's last link (2.3.3.2).

    The linear start solves eq. 2.72 for the unknowns that one light sheet determines. The
    refinement minimises eq. 2.76 over the six parameters of eq. 2.69 and 2.70, weighted by the
    covariance of all residuals: pose errors common to a posture, smooth flatness of the plate,
    stripe noise and the uncertainty of the probed plane. Scatter that is not given is estimated.

    Parameters
    ----------
    stripes
        One entry an exposure; equal postures were taken without moving the arm.
    plate
        The plate in Base.
    options
        Defaults if None.
    sensor_covariance
        (P, P) of the sensor's parameters, in the order of the stripes' ``by_sensor``: its errors
        bend all stripes alike, and are not taken for something that moved. The hand-eye returned,
        and its covariance, are for the sensor as it is; ``sensor_coupling`` carries its errors on.
        None takes it as exact.

    Returns
    -------
    HandEyeFit
        The hand-eye with its covariance and evidence, or why there is none.

    Raises
    ------
    InputError
        If one posture's name stands for different poses.
    """
    options = options or HandEyeOptions()
    check_postures(stripes, options.exposure_position_mm, options.exposure_rotation_rad)
    kept = straight_stripes(stripes, options)
    nodes = replace(
        condense(stripes, kept, options.nodes_per_stripe), sensor_covariance=sensor_covariance
    )
    few = refuse_few_postures(len(nodes.used_postures))
    if few is not None:
        return few
    start = find_start(nodes, plate.plane)
    refusal = _refuse_start(nodes, plate, start, options)
    if refusal is not None:
        also = "".join(f"; {warning}" for warning in point_warnings(stripes, kept, options))
        return FitFailure(refusal.reason + also, refusal.remedy)
    settled = settle_rivals(nodes, plate, start, options, common_to_postures(nodes, plate.plane))
    if isinstance(settled, FitFailure):
        return settled
    mirror = find_mirror(nodes, plate, settled, options)
    if mirror is not None:
        return mirror
    checked = _checked(nodes, plate, settled, options)
    if isinstance(checked, FitFailure):
        return checked
    return _result(stripes, kept, plate, options, start=settled, checked=checked)


def _checked(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions
) -> CheckedFit | FitFailure:
    """Refine, leave wrong postures out, and look for something that moved or is not as given.

    A plate that moved makes postures look wrong, and wrong postures may look like a plate that
    moved. If what moved explains all postures about as well as leaving some out explains the rest,
    it is believed.
    """
    state = PlateState(start.tool_from_sensor, np.zeros(3))
    right = nodes.select(~start.is_wrong[nodes.posture])
    first = fit_plate(right, plate, state, options)
    if isinstance(first, FitFailure):
        return first
    checked = fit_without_wrong_postures(nodes, plate, start, first, options)
    usual_mm = sigma_of(first if isinstance(checked, FitFailure) else checked.fit, "arm")
    trials = [(right, first)]
    if start.is_wrong.any():
        whole = fit_plate(nodes, plate, state, options)
        trials += [(nodes, whole)] if isinstance(whole, PlateFit) else []
    for tried, fit in trials:
        found = find_alternatives(tried, plate, fit, options)
        moved = find_contradiction(found, tried, plate, fit)
        is_all = isinstance(checked, CheckedFit) and fit is checked.fit
        if moved is None or not moved.is_refused:
            continue
        if is_all or moved.arm_mm < AS_WELL * usual_mm:
            return moved.failure
    if isinstance(checked, FitFailure):
        return checked
    found = find_alternatives(checked.nodes, plate, checked.fit, options)
    moved = find_contradiction(found, checked.nodes, plate, checked.fit)
    checked = replace(checked, plane_check=plane_in_words(found))
    if moved is None:
        refusal = refuse_scatter(checked.fit, options)
        return checked if refusal is None else refusal
    if moved.is_refused:
        return moved.failure
    return replace(checked, widening=moved.widening, warnings=(*checked.warnings, moved.reason))


def _refuse_start(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions
) -> FitFailure | None:
    state = PlateState(start.tool_from_sensor, np.zeros(3))
    placed = place_nodes(nodes, plate.plane, state)
    components = noise_components(nodes, placed, plate.plane, options)
    total = total_covariance(components, np.array([c.sigma for c in components]))
    slopes = design(placed, options.solve_plate)
    conditioning = describe_conditioning(hand_eye_information(slopes, total))
    cause = common_to_postures(nodes, plate.plane)
    refusal = refuse_open_hand_eye(conditioning, cause, REMEDY)
    if refusal is not None:
        return refusal
    if not start.typical_mm <= options.max_rms_mm:
        return explain_misfit(nodes, plate, start, options)
    return None


def _result(
    stripes: Sequence[PosedStripe],
    kept: tuple[BoolArray, ...],
    plate: PlateReference,
    options: HandEyeOptions,
    *,
    start: Start,
    checked: CheckedFit,
) -> HandEyeFit | FitFailure:
    """Checks let the sensor err within its covariance; what is stored belongs to the sensor."""
    fit, nodes = checked.fit, checked.nodes
    stored = hold_sensor(nodes, plate, fit, options)
    if isinstance(stored, FitFailure):
        return stored
    conditioning = describe_conditioning(hand_eye_information(fit.slopes, fit.total))
    plane = shifted_plane(plate.plane, plane_after(stored, plate))
    residuals = stripe_residuals(stripes, kept, stored.refined.state.tool_from_sensor, plane)
    left = leave_each_out(nodes, fit.refined.placed.residual_mm, fit.linear)
    postures = posture_results(nodes, stored, residuals, left, plane)
    cause = common_to_postures(nodes, plate.plane)
    return HandEyeFit(
        hand_eye_calibration(
            checked,
            stored,
            plate,
            options,
            conditioning=conditioning,
            residuals=residuals,
            postures=postures,
        ),
        start.linear or start.tool_from_sensor,
        residuals,
        postures,
        conditioning.singular_values,
        reference_facts(plate, options, fit, checked.plane_check),
        (
            *checked.warnings,
            *conditioning_warnings(conditioning, len(postures), cause),
            *agreement_warnings(nodes, plate, stored, options),
            *influence_warnings(nodes, left, fit.covariance[:6, :6]),
            *point_warnings(stripes, kept, options),
        ),
    )
