# SPDX-License-Identifier: Apache-2.0
"""Two crossing sheets of one exposure whose true shape leaves what their parameters describe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from armscan.calibration.hand_eye.estimate import Problem, estimate, joint_covariance
from armscan.calibration.hand_eye.observations import (
    CondensedObservations,
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.surface import (
    PlateSurface,
    place,
)
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import SHEET_PARAMETER_NAMES
from armscan.models.camera import PARAMETER_NAMES as CAMERA_PARAMETER_NAMES
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig, RigNoise, Surface, good_postures

NOISE = RigNoise(exposure_mm=0.0, exposure_rad=0.0)
SHAPE_MM = 0.003
WAVES_MM = (30.0, 90.0)
"""Lengths of the sheets' waves; per rad that is 5 to 14 mm."""
N_CAMERA, N_SHEET = len(CAMERA_PARAMETER_NAMES), len(SHEET_PARAMETER_NAMES)
MIDDLE_MM = np.array([0.0, 0.0, 140.0])
SCALE_MM = 35.0
SHEET_SIGMA_MM = 0.002
FEW = HandEyeOptions(per_stripe=4)


@dataclass(frozen=True)
class CrossRig:
    """A head of one or two sheets on the arm of `PlateRig`, one exposure a posture.

    Parameters
    ----------
    shape_mm
        Standard deviation of the sheets' waves.
    turns
        (rad) of each sheet about the optical axis; 0 is the thesis's.
    """

    shape_mm: float
    turns: tuple[float, ...] = (0.0, 0.5 * np.pi)

    @property
    def heads(self) -> list[PlateRig]:
        postures = good_postures(12, np.random.default_rng(3))
        return [PlateRig(postures, NOISE, sheet_turn_rad=turn) for turn in self.turns]

    @property
    def sensor_covariance(self) -> FloatArray:
        variance = np.full(N_CAMERA + N_SHEET * len(self.turns), SHEET_SIGMA_MM**2)
        variance[:N_CAMERA] = 0.0
        return np.diag(variance)

    def draw(self, seed: int) -> tuple[list[PosedStripe], PlateReference]:
        """Stripes and plate; arm, plate, sheets' parameters and shapes are drawn from the seed."""
        rng = np.random.default_rng(seed)
        heads = self.heads
        surface = Surface.draw(rng, NOISE.flatness_mm)
        plate = heads[0].probe(rng, surface)
        calibration = np.sqrt(np.diag(self.sensor_covariance))
        calibration *= rng.normal(size=len(calibration))
        shapes = [_draw_shape(rng, self.shape_mm) for _ in heads]
        stripes = []
        for k in range(len(heads[0].postures)):
            pose = heads[0].reported_pose(
                k, rng.normal(size=6) * ([NOISE.posture_rad] * 3 + [NOISE.posture_mm] * 3)
            )
            parts = []
            for sheet, (head, shape) in enumerate(zip(heads, shapes, strict=True)):
                clean, across = head.stripe(k, surface)
                along_sheet, by_height = _on_sheet(clean, head.sheet[:3])
                by_sensor = np.zeros((len(clean), 3, len(calibration)))
                own = slice(N_CAMERA + N_SHEET * sheet, N_CAMERA + N_SHEET * (sheet + 1))
                by_sensor[:, :, own] = by_height[:, :, None] * _terms(along_sheet)[:, None, :]
                noise = NOISE.stripe_mm * rng.normal(size=(len(clean), 1)) * across
                wrong = by_sensor @ calibration - by_height * shape.height(along_sheet)[:, None]
                parts.append((clean + noise + wrong, across, by_sensor))
            count = [len(points) for points, _, _ in parts]
            across = np.concatenate(
                [np.tile(part[1], (n, 1)) for part, n in zip(parts, count, strict=True)]
            )
            stripes.append(
                PosedStripe(
                    source=f"image{k:02d}",
                    posture=f"posture{k:02d}",
                    base_from_tool=pose,
                    points_mm=np.concatenate([part[0] for part in parts]),
                    noise_mm=NOISE.stripe_mm * across[:, :, None],
                    sheet=np.repeat(np.arange(len(heads)), count),
                    dpoint_dsensor=np.concatenate([part[2] for part in parts]),
                )
            )
        return stripes, plate


def _draw_shape(rng: np.random.Generator, sigma_mm: float, count: int = 12) -> Surface:
    length, direction = rng.uniform(*WAVES_MM, count), rng.uniform(0.0, np.pi, count)
    vectors = np.column_stack([np.cos(direction), np.sin(direction)])
    amplitudes = sigma_mm / np.sqrt(count) * rng.normal(size=(count, 2))
    return Surface(2.0 * np.pi / length[:, None] * vectors, amplitudes, np.zeros(count))


def _on_sheet(points_mm: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (N, 2) along the sheet, and moves (N, 3) along the rays per mm of its height."""
    first = np.cross(normal, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    places = (points_mm - MIDDLE_MM) @ np.stack([first, np.cross(normal, first)]).T
    return places, points_mm / (points_mm @ normal)[:, None]


def _terms(places_mm: FloatArray) -> FloatArray:
    """(N, 8) height of a sheet by its parameters, in the order of the calibration."""
    u, v = places_mm.T / SCALE_MM
    return np.column_stack([u, v, np.ones(len(u)), u * u, u * v, v * v, u**3, u * u * v])


def _nodes(rig: CrossRig, stripes: list[PosedStripe]) -> CondensedObservations:
    nodes = condense_plate(stripes, straight_stripes(stripes), 4)
    return replace(nodes, sensor_covariance=rig.sensor_covariance)


def _runs(options: HandEyeOptions, n_runs: int) -> tuple[FloatArray, FloatArray]:
    """Scatters (n, 2) of arm and sheets (mm), and normalised squares (n,) of the errors."""
    rig = CrossRig(SHAPE_MM)
    sigmas, squares = [], []
    for seed in range(n_runs):
        stripes, plate = rig.draw(seed)
        nodes = _nodes(rig, stripes)
        problem = Problem(nodes, PlateSurface(plate), options)
        fit = estimate(problem, problem.start(TOOL_FROM_SENSOR))
        assert fit is not None
        error = fit.state.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
        total = joint_covariance(fit).unknowns[:6, :6]
        sigmas.append([fit.arm_mm, fit.sigma_of("sheet shape")])
        squares.append(float(error @ np.linalg.solve(total, error)))
    return np.array(sigmas), np.array(squares)


def test_the_sheets_own_shape_is_not_taken_for_the_arms_scatter() -> None:
    """Twelve postures tell a scatter to a fifth: 0.6 to 1.65 of it are 2.5 of that.

    Seen is the arm's shift with what its turn about Tool throws the scan point by, along normals
    25 degrees from the line between both, on average.
    """
    sigmas, squares = _runs(FEW, 4)
    apart_mm = float(np.linalg.norm(TOOL_FROM_SENSOR.apply(MIDDLE_MM)))
    true_mm = np.hypot(NOISE.posture_mm, NOISE.posture_rad * apart_mm * np.sin(np.radians(25.0)))
    assert sigmas[:, 0].min() > 0.6 * true_mm and sigmas[:, 0].max() < 1.65 * true_mm
    assert (sigmas[:, 1] > 0.3 * SHAPE_MM).all() and (sigmas[:, 1] < 2.0 * SHAPE_MM).all()
    assert squares.sum() < chi2.ppf(0.999, 6 * len(squares))
    exact, _ = _runs(replace(FEW, sheet_shape_mm=0.0), 4)
    larger = float(np.mean(exact[:, 0] / sigmas[:, 0]))
    assert larger > 1.1, "these draws would not notice a missing part"


def test_a_sheets_shape_moves_a_residual_as_the_sheets_height_does() -> None:
    """By hand: the sheet's points raised by 1 mm along their rays; the other sheet has its own.

    Noise and flatness of some micrometres in 140 mm leave 1e-4 between the two.
    """
    rig = CrossRig(0.0)
    stripes, plate = rig.draw(0)
    nodes = _nodes(rig, stripes)
    problem = Problem(nodes, PlateSurface(plate), FEW)
    state = problem.start(TOOL_FROM_SENSOR)
    placed = problem.place(state)
    found = {c.name: c for c in problem.components(placed)}["sheet shape"]
    moved = np.zeros(len(nodes))
    for sheet, head in enumerate(rig.heads):
        own = nodes.sheet == sheet
        raised = nodes.points_mm.copy()
        raised[own] += _on_sheet(nodes.points_mm[own], head.sheet[:3])[1]
        there = place(replace(nodes, points_mm=raised), problem.surface, state)
        moved += there.residual_mm - placed.residual_mm
    np.testing.assert_allclose(np.diag(found.covariance), moved**2, rtol=1e-4)
    assert found.is_estimated
    alike = found.covariance / np.outer(moved, moved)
    assert not alike[nodes.sheet[:, None] != nodes.sheet[None, :]].any()
    apart = np.linalg.norm(nodes.points_mm[:, None] - nodes.points_mm[None], axis=2)
    other_posture = nodes.posture[:, None] != nodes.posture[None, :]
    near = other_posture & (nodes.sheet[:, None] == nodes.sheet[None, :]) & (apart < 3.0)
    assert near.any() and (alike[near] > 0.95).all(), "the sheet travels with the head"


def test_points_without_a_sheet_have_no_such_part() -> None:
    rig = CrossRig(0.0)
    stripes, plate = rig.draw(0)
    nodes = replace(_nodes(rig, stripes), dpoint_dsensor=None)
    problem = Problem(nodes, PlateSurface(plate), FEW)
    placed = problem.place(problem.start(TOOL_FROM_SENSOR))
    names = [component.name for component in problem.components(placed)]
    assert "sheet shape" not in names
