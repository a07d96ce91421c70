# SPDX-License-Identifier: Apache-2.0
"""A running scan is watched: angle of sight, coverage, passes apart, distance from the model."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.console.quality import (
    Incidence,
    ModelWatch,
    coverage,
    deviations_mm,
    passes_apart_mm,
)
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray
from armscan.pipeline.live.session import ShownCloud


def lines(tilt_deg: float, n_lines: int = 12, step_mm: float = 1.0) -> ShownCloud:
    """A pass over a plane that is tilted about Y, lines along Y, a point every 0.5 mm."""
    rng = np.random.default_rng(4)
    along = np.arange(0.0, 40.0, 0.5)
    x = np.repeat(step_mm * np.arange(n_lines), len(along))
    flat = np.column_stack([x, np.tile(along, n_lines), rng.normal(0.0, 0.01, len(x))])
    turned = flat @ Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix().T
    exposure = np.repeat(np.arange(n_lines), len(along))
    return ShownCloud(turned, np.zeros(len(x), int), np.full(len(x), 0.01), exposure)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, 60.0])
def test_the_angle_of_sight_is_that_to_the_surface(tilt_deg: float) -> None:
    cloud = lines(tilt_deg)
    far_above = {k: np.array([0.0, 0.0, 1e6]) for k in range(12)}
    found = Incidence().angles_deg(cloud, far_above)
    inner = (cloud.exposure > 1) & (cloud.exposure < 10)
    assert np.isfinite(found[inner]).all()
    # a plane of 24 points over 5 mm that scatter by 0.01 mm is known to 0.2 degrees
    assert np.median(found[inner]) == pytest.approx(tilt_deg, abs=0.5)
    assert np.abs(found[inner] - tilt_deg).max() < 3.0


def test_angles_are_the_same_whether_a_cloud_comes_at_once_or_grows() -> None:
    whole = lines(40.0)
    seen_from = {k: np.array([5.0, 20.0, 150.0]) for k in range(12)}
    grown = Incidence()
    for n in (1, 2, 5, 9, 12):
        part = whole.exposure < n
        cloud = ShownCloud(
            whole.points_mm[part], whole.sheet[part], whole.sigma_mm[part], whole.exposure[part]
        )
        found = grown.angles_deg(cloud, seen_from)
    at_once = Incidence().angles_deg(whole, seen_from)
    np.testing.assert_allclose(found, at_once, atol=3.0)


def test_a_single_line_tells_no_surface_and_no_angle() -> None:
    one = lines(0.0, n_lines=1)
    assert np.isnan(Incidence().angles_deg(one, {0: np.array([0.0, 0.0, 100.0])})).all()
    apart = lines(0.0, step_mm=20.0)
    assert np.isnan(Incidence().angles_deg(apart, {})).all()
    none = replace(one, points_mm=np.zeros((0, 3)), exposure=np.zeros(0, int))
    assert Incidence().angles_deg(none, {}).shape == (0,)


def test_coverage_counts_the_points_of_a_cell() -> None:
    points = np.array([[0.1, 0.1, 0.1], [1.9, 1.9, 1.9], [2.1, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    assert coverage(points, 2.0).tolist() == [2, 2, 1, 1]
    far = np.array([[-1e6, 0.0, 0.0], [1e6, 1e6, 1e6]])
    assert coverage(far, 2.0).tolist() == [1, 1]
    assert coverage(np.zeros((0, 3)), 2.0).shape == (0,)


@pytest.mark.parametrize("apart_mm", [0.0, 0.08, -0.08])
def test_passes_that_lie_apart_are_noticed(apart_mm: float) -> None:
    rng = np.random.default_rng(5)
    first, second = (
        np.column_stack([rng.uniform(0, 40, (4000, 2)), rng.normal(0, 0.005, 4000)])
        for _ in range(2)
    )
    second[:, 2] += apart_mm
    found = passes_apart_mm(first, second)
    # median of |N(0, sqrt(1 + 1/12) 0.005)| where they agree
    assert found == pytest.approx(max(abs(apart_mm), 0.0035), abs=0.002)
    assert passes_apart_mm(first, second + np.array([0.0, 0.0, 50.0])) is None
    assert passes_apart_mm(first[:10], second) is None


CORNERS = np.array([[x, y, z] for x in (0, 60) for y in (0, 35) for z in (0, 20)], dtype=float)
FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)


def block(path: Path) -> Path:
    """A block of 60 x 35 x 20 mm as an OBJ file."""
    rows = [f"v {x} {y} {z}" for x, y, z in CORNERS.tolist()]
    rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    path.write_text("\n".join(rows) + "\n")
    return path


def seen_block(too_high_mm: float) -> FloatArray:
    """Points on top and two sides of the block, and of the table beside it, turned and moved."""
    rng = np.random.default_rng(6)
    side = rng.uniform(0.0, 1.0, (3, 3000, 3)) * [60.0, 35.0, 20.0]
    side[0, :, 2] = 20.0 + too_high_mm
    side[1, :, 0], side[2, :, 1] = 60.0, 0.0
    points = side.reshape(-1, 3) + rng.normal(0.0, 0.005, (9000, 3))
    turn = Rotation.from_euler("xyz", [10, 20, 70], degrees=True).as_matrix()
    return np.asarray(points @ turn.T + [300.0, -200.0, 50.0])


def test_a_growing_cloud_shows_its_deviations_from_the_model(tmp_path: Path) -> None:
    part = block(tmp_path / "block.obj")
    pose, found = deviations_mm(part, seen_block(0.0), None)
    # noise of 0.005 mm
    assert np.abs(found).max() < 0.05 and np.median(found) == pytest.approx(0.0, abs=1e-3)
    again, high = deviations_mm(part, seen_block(0.3), pose)
    assert again is pose, "it stays where it was laid"
    assert np.median(high[:3000]) == pytest.approx(0.3, abs=0.01)
    assert np.median(high[3000:]) == pytest.approx(0.0, abs=0.01)
    _, far = deviations_mm(part, seen_block(30.0), pose)
    assert np.isnan(far[:3000]).mean() > 0.9, "what lies beside the part has no deviation"


class SlowWorker:
    """Does not answer until it is told to."""

    def __init__(self) -> None:
        self.n_asked, self.may_end = 0, threading.Event()

    def run(self, *_: object) -> tuple[None, FloatArray]:
        self.n_asked += 1
        assert self.may_end.wait(30.0)
        return None, np.zeros(0)


def test_a_watch_that_has_ended_keeps_the_worker_from_nobody() -> None:
    worker, cloud = SlowWorker(), lines(0.0)
    watch = ModelWatch(worker, Path("part.stl"))  # type: ignore[arg-type]
    watch.latest(cloud)
    ending = threading.Thread(target=watch.end)
    ending.start()
    ending.join(0.1)
    assert ending.is_alive(), "the worker is not free yet"
    worker.may_end.set()
    ending.join(30.0)
    assert not ending.is_alive()
    watch.latest(cloud)
    assert worker.n_asked == 1


def test_a_cloud_of_something_else_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(ArmscanError):
        deviations_mm(block(tmp_path / "block.obj"), rng.uniform(0, 60, (3000, 3)), None)
