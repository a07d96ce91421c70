# SPDX-License-Identifier: Apache-2.0
"""Recordings of the drawn bench on an arm that errs not at all: a plate in Base, and a hand-eye."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rigs.drawn_bench import HEIGHT, WIDTH, draw

ROTATION = cv2.Rodrigues(np.array([0.3, -0.8, 1.7]))[0]
TRANSLATION_MM = np.array([40.0, 20.0, 110.0])
PLATE = np.array([0.02, -0.01, 1.0]) / np.linalg.norm([0.02, -0.01, 1.0])
PLATE_D_MM = -25.0
PLANE = ",".join(f"{value:.12f}" for value in (*PLATE, PLATE_D_MM))
POSTURES = (
    (0, 0, 150.0), (30, 5, 140.0), (-30, -5, 160.0), (5, 30, 165.0), (-5, -30, 138.0),
    (25, 22, 145.0), (-22, 25, 158.0), (12, -28, 152.0),
)  # fmt: skip
SESSION = f"""kind = "calibration"
[pose]
form = "matrix"
[time]
clock = "shared"
[[camera]]
width_px = {WIDTH}
height_px = {HEIGHT}
"""


def draw_postures(folder: Path, *, of_target: bool = False) -> None:
    """The plate from several postures at rest; the poses are those of the images, exactly.

    ``of_target``: The target at rest in place of the plate, without laser.
    """
    (folder / "images").mkdir(parents=True)
    exposures, samples = ["index,t_ns,camera,file,lasers,view"], [_ARM_HEADER]
    for k, (a, b, z) in enumerate(POSTURES):
        image = draw(a, b, z, has_laser=not of_target, is_plain=not of_target)
        cv2.imwrite(str(folder / "images" / f"{k}.png"), image)
        time = 10**9 * (k + 1)
        exposures.append(f"{k},{time},0,images/{k}.png,{'' if of_target else 'A'},p{k}")
        rotation, place = base_from_tool(a, b, z, 0 if of_target else k)
        numbers = ",".join(f"{value!r}" for value in [*place.tolist(), *rotation.ravel().tolist()])
        samples += [f"{time + shift},{numbers}" for shift in (-(10**7), 10**7)]
    (folder / "session.toml").write_text(SESSION)
    (folder / "exposures.csv").write_text("\n".join(exposures) + "\n")
    (folder / "arm.csv").write_text("\n".join(samples) + "\n")


_ARM_HEADER = "t_ns,x_mm,y_mm,z_mm," + ",".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))


def base_from_tool(
    tilt_x_deg: float, tilt_y_deg: float, z_mm: float, k: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of the tool for one image of the board; ``k`` turns it on the plate."""
    in_sensor = cv2.Rodrigues(np.array([0.0, np.deg2rad(tilt_y_deg), 0.0]))[0]
    in_sensor = in_sensor @ cv2.Rodrigues(np.array([np.deg2rad(tilt_x_deg), 0.0, 0.0]))[0]
    # the board's z axis points away from the camera, the plate's normal towards it
    along = np.cross(PLATE, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(PLATE, [0.0, 1.0, 0.0]))
    plate_axes = np.column_stack([along, -np.cross(PLATE, along), -PLATE])
    turn = cv2.Rodrigues(0.8 * k * PLATE)[0]
    middle = -PLATE_D_MM * PLATE + 20.0 * np.cos(k) * plate_axes[:, 0]
    base_from_board = turn @ plate_axes
    base_from_sensor = base_from_board @ in_sensor.T
    sensor_place = middle - base_from_sensor @ [0.0, 0.0, z_mm]
    rotation = base_from_sensor @ ROTATION.T
    return rotation, sensor_place - rotation @ TRANSLATION_MM


LATENCY_NS = 6_300_000
_ASIDE_HZ, _TURN_HZ = 0.31, 0.43


def draw_bounce(folder: Path, *, seconds: float = 6.0, bounce_mm: float = 6.0) -> None:
    """The head moved nearer and away for seconds; the arm tells its times `LATENCY_NS` late."""

    def held(t_s: float) -> tuple[float, float, float, float]:
        away = np.sin(2 * np.pi * 0.9 * t_s) + 0.6 * np.sin(2 * np.pi * 1.43 * t_s + 1.0)
        tilt = 8.0 + 4.0 * np.sin(2 * np.pi * _TURN_HZ * t_s)
        return tilt, -3.0, 150.0 + bounce_mm * away, 1.0 + 0.5 * np.sin(2 * np.pi * _ASIDE_HZ * t_s)

    (folder / "images").mkdir(parents=True)
    exposures, samples = ["index,t_ns,camera,file,lasers"], [_ARM_HEADER]
    for k in range(round(20 * seconds)):
        t_s = 1.0 + k / 20
        tilt_x, tilt_y, z_mm, _ = held(t_s)
        image = draw(tilt_x, tilt_y, z_mm, has_laser=True, is_plain=True)
        cv2.imwrite(str(folder / "images" / f"{k:03d}.png"), image)
        exposures.append(f"{k},{round(1e9 * t_s)},0,images/{k:03d}.png,A")
    for k in range(round(200 * (seconds + 0.4))):
        t_s = 0.8 + k / 200
        rotation, place = base_from_tool(*held(t_s))
        numbers = ",".join(f"{value!r}" for value in [*place.tolist(), *rotation.ravel().tolist()])
        samples.append(f"{round(1e9 * t_s) + LATENCY_NS},{numbers}")
    (folder / "session.toml").write_text(SESSION)
    (folder / "exposures.csv").write_text("\n".join(exposures) + "\n")
    (folder / "arm.csv").write_text("\n".join(samples) + "\n")
