# SPDX-License-Identifier: Apache-2.0
"""What twelve postures can tell of the hand-eye: the twin's plan, random ones, an exchanged one.

The Cramer-Rao bound of the six parameters from the geometry of stripes on a plate alone: 0.0045 mm
along the plate's normal and 2e-5 rad along the stripe, common to a posture; flatness of 0.003 mm
correlated over 30 mm; 0.002 mm and 3e-5 rad of a plate probed once; 0.003 mm a point.

    python benchmarks/hand_eye_plan.py [--exchanges 300]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from armscan.simulation.arm.hand import HeadOrientation
from armscan.simulation.head import Head, build_head, sheet_middle_mm
from armscan.simulation.scenes import hand_eye_plan

POINTS = 21
SCAN_POINT_MM = np.array([0.0, 0.0, 137.0])
LEAST_LENGTH_MM = 50.0


def stripe(head: Head, aim: HeadOrientation) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the stripe in Sensor that the camera sees, and the plate's normal there."""
    laser = head.lasers[0]
    normal = aim.rotation()[2]
    middle = sheet_middle_mm(head, aim.depth_mm)
    rays = laser.rays(np.linspace(-laser.half_angle_rad, laser.half_angle_rad, 241))
    reach = (normal @ (middle - laser.source_mm)) / (rays @ normal)
    points = laser.source_mm + reach[:, None] * rays
    pixels = head.camera.project(points)
    size = [head.camera.width_px, head.camera.height_px]
    return points[((pixels > 0.0) & (pixels < size)).all(axis=1) & (reach > 0.0)], normal


def bound(head: Head, plan: tuple[HeadOrientation, ...]) -> np.ndarray | None:
    """(6, 6) covariance of turns (rad) and shifts (mm) in Sensor; None if a stripe is short."""
    rows, places, groups, along = [], [], [], []
    for k, aim in enumerate(plan):
        points, normal = stripe(head, aim)
        if len(points) < POINTS or np.linalg.norm(points[-1] - points[0]) < LEAST_LENGTH_MM:
            return None
        points = points[np.linspace(0, len(points) - 1, POINTS).astype(int)]
        rows.append(np.hstack([np.cross(points, normal), np.tile(normal, (POINTS, 1))]))
        spot = 22.0 * np.array([np.cos(2.4 * k), np.sin(2.4 * k)])
        on_plate = (points - points.mean(axis=0)) @ aim.rotation().T
        places.append(on_plate[:, :2] + spot)
        groups.append(np.full(POINTS, k))
        along.append((points - points.mean(axis=0))[:, 0])
    jacobian, xy, group, s = (np.concatenate(part) for part in (rows, places, groups, along))
    same = group[:, None] == group
    apart = np.sum((xy[:, None] - xy) ** 2, axis=2)
    plate = np.column_stack([np.full(len(xy), 0.002), 3e-5 * xy])
    noise = same * (0.0045**2 + (2e-5**2) * np.outer(s, s)) + 0.003**2 * np.eye(len(xy))
    noise += 0.003**2 * np.exp(-0.5 * apart / 30.0**2) + plate @ plate.T
    return np.linalg.inv(jacobian.T @ np.linalg.solve(noise, jacobian))


def at_scan_point(covariance: np.ndarray) -> np.ndarray:
    """(3,) standard deviations in mm of the point that is scanned."""
    x, y, z = SCAN_POINT_MM
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    change = np.hstack([-cross, np.eye(3)])
    return np.sqrt(np.diag(change @ covariance @ change.T))


def cost(head: Head, plan: tuple[HeadOrientation, ...]) -> float:
    """Root mean square over the scan point's three errors and three turns at 40 mm."""
    covariance = bound(head, plan)
    if covariance is None:
        return np.inf
    turns = 40.0 * np.sqrt(np.diag(covariance)[:3])
    return float(np.sqrt(np.mean(np.square([*at_scan_point(covariance), *turns]))))


def drawn(rng: np.random.Generator, steepest_deg: float = 45.0) -> HeadOrientation:
    """A posture tilted by 30-45 degrees to any side that laser and camera can stand."""
    while True:
        tilt, azimuth = rng.uniform(30.0, steepest_deg), rng.uniform(0.0, 2.0 * np.pi)
        x, y = tilt * np.cos(azimuth), tilt * np.sin(azimuth)
        if -50.0 < x < 12.0:
            return HeadOrientation(x, y, rng.uniform(-180.0, 180.0), rng.uniform(122.0, 160.0))


def show(name: str, head: Head, plan: tuple[HeadOrientation, ...]) -> None:
    covariance = bound(head, plan)
    if covariance is None:
        print(f"{name:<22} a stripe is out of view")
        return
    sigma = np.sqrt(np.diag(covariance))
    turns = " ".join(f"{value:7.4f}" for value in np.degrees(sigma[:3]))
    shifts = " ".join(f"{value:7.4f}" for value in sigma[3:])
    point = " ".join(f"{value:7.4f}" for value in at_scan_point(covariance))
    print(f"{name:<22} {turns}   {shifts}   {point}   {cost(head, plan):7.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exchanges", type=int, default=300)
    exchanges = parser.parse_args().exchanges
    head = build_head(seed=1)
    rng = np.random.default_rng(1)
    heads = ("plan", "turns x y z, deg", "shifts x y z, mm", "scan point, mm", "cost, mm")
    print("{:<22} {:<25} {:<25} {:<25} {}".format(*heads), "(head and draws: seed 1)")
    plan = tuple(hand_eye_plan(head))
    show("the twin's", head, plan)
    for k in range(4):
        show(f"random {k + 1}", head, tuple(drawn(rng) for _ in plan))
    best, lowest = plan, cost(head, plan)
    for k in range(exchanges):
        at = k % len(best)
        tilted = replace(
            best[at],
            tilt_x_deg=rng.uniform(-50.0, 12.0),
            tilt_y_deg=rng.uniform(-45.0, 45.0),
            depth_mm=rng.uniform(122.0, 160.0),
        )
        other = (*best[:at], tilted, *best[at + 1 :])
        found = cost(head, other)
        if found < lowest:
            best, lowest = other, found
    show(f"{exchanges} exchanges tried", head, best)


if __name__ == "__main__":
    main()
