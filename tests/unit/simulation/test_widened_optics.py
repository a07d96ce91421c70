# SPDX-License-Identifier: Apache-2.0
"""Sections that are no Gaussian, paper in which light spreads, bowed boards, colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Board, Pose, Sensor
from armscan.simulation.head import Head, Tolerances, Window, build_head
from armscan.simulation.objects.boards import CirclePattern, PrintedBoard, Substrate
from armscan.simulation.objects.shapes import FlatPlate
from armscan.simulation.optics.camera import RenderCamera
from armscan.simulation.optics.lasers import LineLaser, Section
from armscan.simulation.optics.render import Speckle
from armscan.simulation.optics.scene import SceneObject
from armscan.simulation.station import (
    ExposureSettings,
    Station,
    Target,
    exposure_light,
    render_exposure,
)
from rigs.flat_prints import Lighting, render_flat_target
from rigs.photographed_instrument import MisruledChessboard, draw_instrument

LOPSIDED = Section(skew=0.3, tail_low=0.05, tail_high=0.15, tail_sigmas=2.0)


def brightness(section: Section, reach: FloatArray) -> FloatArray:
    """The definition, side by side, without the detour over a Gaussian's reach."""
    side = np.where(reach > 0, 1.0 + section.skew, 1.0 - section.skew)
    tail = np.where(reach > 0, section.tail_high, section.tail_low)
    u = reach / side
    return (1 - tail) * np.exp(-0.5 * u**2) + tail * np.exp(-0.5 * (u / section.tail_sigmas) ** 2)


def quiet_head(section: Section) -> Head:
    """A single line without speckle, halo or room light."""
    head = build_head("thesis-single", "clean", 1, Tolerances(*[0.0] * 8))
    imaging = replace(head.imaging, speckle=Speckle(0.0, 0.0), ambient=0.0)
    lasers = tuple(replace(laser, section=section) for laser in head.lasers)
    return replace(head, lasers=lasers, imaging=imaging)


def test_a_section_is_as_bright_as_it_is_defined_and_its_peak_stays() -> None:
    reach = np.linspace(-30.0, 30.0, 2001)
    seen = np.exp(-0.5 * LOPSIDED.gaussian_reach(reach) ** 2)
    np.testing.assert_allclose(seen, brightness(LOPSIDED, reach), rtol=1e-9, atol=1e-15)
    assert seen.argmax() == 1000
    assert (Section().gaussian_reach(reach) == reach).all()


def test_moments_of_the_light_on_a_wall_are_those_of_the_section() -> None:
    """Power, centroid and third moment over a wall, by quadrature of the definition."""
    laser = LineLaser(
        "A",
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([0.0, 1.0, 0.0]),
        waist_mm=0.2,
        divergence_rad=0.0,
        section=LOPSIDED,
    )
    x = np.linspace(-3.0, 3.0, 6001)
    wall = np.stack([x, 0 * x, np.full_like(x, 300.0)], axis=1)
    light = laser.irradiance_at(wall, np.tile([0.0, 0.0, -1.0], (len(x), 1)))
    along = wall @ laser.normal
    for k in range(4):
        expected = quad(
            lambda r, k=k: r**k * float(brightness(LOPSIDED, np.array(r))), -15, 15, points=[0.0]
        )[0]
        found = (light * along**k).sum() * (x[1] - x[0]) / 0.2 ** (k + 1)
        assert found == pytest.approx(expected, rel=1e-3), k


def test_a_rendered_line_has_the_centroid_of_its_section() -> None:
    """Blur, pixels and interpolation keep the centroid; a Gaussian's would lie 0.4 sigma away."""
    head = quiet_head(LOPSIDED)
    plate = SceneObject("plate", FlatPlate(np.array([200.0, 150.0])))
    rotation = np.diag([1.0, -1.0, -1.0])
    pose: Pose[Base, Sensor] = Pose(rotation, -rotation @ np.array([0.0, 4.158, 140.0]))
    window = Window(1400, 900, 96, 400)
    settings = ExposureSettings(window, ("A",))
    light = exposure_light(head, Station((plate,)), [pose], settings, np.random.default_rng(0))
    laser, camera = head.lasers[0], head.camera
    column = window.x_px + 48
    rows = np.arange(window.y_px, window.y_px + window.height_px)

    def reach(v: FloatArray) -> FloatArray:
        xy = camera.rays(np.stack([np.full_like(v, column), v], axis=1))
        points = np.concatenate([xy, np.ones((len(v), 1))], axis=1) * 140.0
        away = np.linalg.norm(points - laser.source_mm, axis=1)
        return laser.offset_mm(points) / laser.thickness_mm(away)

    fine = np.linspace(rows[0], rows[-1], 80 * len(rows))
    shape = brightness(LOPSIDED, reach(fine))
    expected = (shape * fine).sum() / shape.sum()
    profile = light[:, 48].astype(np.float64)
    found = (profile * rows).sum() / profile.sum()
    peak = brentq(lambda v: float(reach(np.array([v]))[0]), rows[0], rows[-1])
    assert found == pytest.approx(expected, abs=0.01)
    assert abs(found - peak) > 0.5


def test_what_is_no_section_is_refused() -> None:
    for wrong in ({"skew": 1.0}, {"tail_low": -0.1}, {"tail_high": 1.0}, {"tail_sigmas": 0.5}):
        with pytest.raises(InputError):
            Section(**wrong)


def camera() -> RenderCamera:
    return RenderCamera(2000.0, 2000.0, 160.0, 120.0, width_px=320, height_px=240)


PATTERN = CirclePattern(5, 4, 4.0, 2.4)
PLACE = (np.eye(3), np.array([-8.0, -6.0, 140.0]))


def test_spread_light_follows_a_convolution_on_both_sides_of_an_edge() -> None:
    """Light passes the print, spreads by exp(-|x| / s) and passes the print again."""
    paper = Substrate(spread_mm=0.2, ink=0.3)

    def spread(y: float, x: float) -> float:
        return (0.3 if y < 0 else 1.0) * float(np.exp(-abs(x - y) / 0.2)) / 0.4

    for x in (-0.5, -0.1, -0.01, 0.01, 0.1, 0.5):  # the ink lies at x < 0
        under = sum(quad(spread, *part, args=(x,))[0] for part in ((-9, -1), (1, 9)))
        under += quad(spread, -1, 1, args=(x,), points=[0.0, x])[0]
        share = ((0.3 if x < 0 else 1.0) * under - 0.09) / (1.0 - 0.09)
        found = paper.reflectance(np.array([x > 0]), np.array([abs(x)]))[0]
        assert found == pytest.approx(share, abs=2e-4)


def test_spread_light_darkens_the_paper_and_leaves_a_circle_its_centre() -> None:
    sharp, soft = (
        render_flat_target(camera(), PATTERN, *PLACE, Lighting(), substrate=Substrate(spread))
        for spread in (0.0, 0.1)
    )
    assert soft.image.sum() < sharp.image.sum()
    u, v = sharp.marks_px[6]
    x, y = round(float(u)), round(float(v))
    patch = 200.0 - soft.image[y - 25 : y + 26, x - 25 : x + 26]
    at = np.arange(-25, 26)
    assert (patch.sum(axis=0) @ at) / patch.sum() + x == pytest.approx(u, abs=0.02)
    assert (patch.sum(axis=1) @ at) / patch.sum() + y == pytest.approx(v, abs=0.02)


def test_a_bowed_board_is_seen_where_its_parabola_is() -> None:
    """The marks' images against the parabola, the laser's hits, and a flat board's image."""
    bow = Substrate(bow_mm=(1.5, 0.0))
    bowed = render_flat_target(camera(), PATTERN, *PLACE, Lighting(), substrate=bow)
    x_min, _, x_max, _ = PATTERN.extent_board_mm
    marks = PATTERN.marks_board_mm
    share = (marks[:, 0] - 0.5 * (x_min + x_max)) / (0.5 * (x_max - x_min))
    raised = marks + np.stack([0 * share, 0 * share, 1.5 * (1 - share**2)], axis=1)
    np.testing.assert_allclose(bowed.marks_px, camera().project(raised + PLACE[1]), atol=1e-9)
    u, v = bowed.marks_px[0]
    x, y = round(float(u)), round(float(v))
    patch = 200.0 - bowed.image[y - 22 : y + 23, x - 22 : x + 23]
    at = np.arange(-22, 23)
    assert (patch.sum(axis=0) @ at) / patch.sum() + x == pytest.approx(u, abs=0.05)
    board = PrintedBoard(PATTERN, Pose(*PLACE), substrate=bow)
    rays = np.concatenate([camera().rays(bowed.marks_px), np.ones((len(marks), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = rays * board.intersect(np.zeros((1, 3)), rays)[:, None]
    np.testing.assert_allclose(hits, raised + PLACE[1], atol=1e-5)
    slope = -2.0 * 1.5 * share / (0.5 * (x_max - x_min))
    normals = board.normals(hits)
    np.testing.assert_allclose(normals[:, 0] / -normals[:, 2], slope, atol=1e-4)


def test_a_colour_camera_sees_the_laser_in_its_colour_and_the_room_in_white() -> None:
    head = quiet_head(Section())
    head = replace(head, imaging=replace(head.imaging, laser_colour=(0.1, 1.0, 0.0)))
    board: Pose[Base, Board] = Pose(np.eye(3), np.array([-18.0, -15.0, 140.0]))
    station = Station((), Target(CirclePattern(11, 9, 3.75, 1.875), board))
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    window = Window(1300, 800, 200, 400)
    pictures = [
        render_exposure(
            head, station, [here], ExposureSettings(window, lasers, light), np.random.default_rng(1)
        ).astype(np.float64)
        for lasers, light in ((("A",), 0.0), ((), 0.5))
    ]
    line, room = (picture.reshape(-1, 3).sum(axis=0) for picture in pictures)
    assert line[0] == pytest.approx(0.1 * line[1], rel=0.05)
    assert line[2] < 0.01 * line[1]
    np.testing.assert_allclose(room, room.mean(), rtol=0.01)


def test_printing_errors_are_as_large_as_drawn_and_move_the_print() -> None:
    """Errors over drawn instruments: their scatter, and a chessboard's tone follows its lines."""
    boards = [draw_instrument(seed) for seed in range(60)]
    ratios = []
    for drawn in boards:
        if not isinstance(drawn.pattern, MisruledChessboard) or not drawn.facts["misprint_mm"]:
            continue
        pattern = drawn.pattern
        j, i = np.mgrid[: pattern.rows, : pattern.columns]
        ideal = np.stack([i, j], axis=-1).reshape(-1, 2) * pattern.square_mm
        shift = pattern.marks_board_mm[:, :2] - ideal
        ratios.append(shift[: pattern.columns, 0] / drawn.facts["misprint_mm"])
        x, y, _ = pattern.marks_board_mm[pattern.columns + 1]
        step = 1e-6 * pattern.square_mm
        around = np.array([[-step, -step], [step, -step], [-step, step], [step, step]])
        tones = pattern.is_light(x + around[:, 0], y + around[:, 1])
        assert tones[0] == tones[3] != tones[1] == tones[2]
        assert pattern.edge_distance_mm(np.array([x + step]), np.array([y]))[0] <= step
    every = np.concatenate(ratios)
    # standard deviation of n normal numbers: 1 within 3 / sqrt(2 n)
    assert every.std() == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * len(every)))
