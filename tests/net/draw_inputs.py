# SPDX-License-Identifier: Apache-2.0
"""Draws the images and tables under ``inputs/``: once, with nothing of the package.

A pinhole camera (and a second one), a chessboard, light sheets from one place, a plate and a ball
before an arm without error but a little scatter. Kept as files, so that another version of the
drawing libraries changes no input.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

INPUTS = Path(__file__).parent / "inputs"
WIDTH, HEIGHT, FOCAL = 480, 360, 600.0
COLUMNS, ROWS, SQUARE_MM = 8, 6, 6.0
OVERSAMPLING = 3
DISTANCE_MM = 150.0
EMITTER = np.array([-62.0, 4.0, 8.0])
MIDDLE = np.array([0.0, 0.0, DISTANCE_MM])
CAMERA_TILTS = (
    (0, 0), (28, 5), (-28, -5), (5, 30), (-5, -30), (22, 22), (-22, 20), (18, -24),
)  # fmt: skip
LASER_PLACES = ((10, -10, 122.0), (-22, 18, 150.0), (25, 20, 178.0), (-12, -20, 160.0))
MULTI_PLACES = ((8, -8, 135.0), (-20, 12, 150.0), (22, 14, 160.0), (4, 22, 145.0))
POSTURES: tuple[tuple[float, float, float], ...] = (
    (0, 0, 150.0), (30, 5, 140.0), (-30, -5, 160.0), (5, 30, 165.0), (-5, -30, 138.0),
    (25, 22, 145.0), (-22, 25, 158.0), (12, -28, 152.0), (-26, -18, 148.0), (18, 12, 162.0),
)  # fmt: skip
TOOL_FROM_SENSOR_R = cv2.Rodrigues(np.array([0.3, -0.8, 1.7]))[0]
TOOL_FROM_SENSOR_T = np.array([40.0, 20.0, 110.0])
PLATE = np.array([0.02, -0.01, 1.0]) / np.linalg.norm([0.02, -0.01, 1.0])
PLATE_D_MM = -25.0
BALL_RADIUS_MM = 15.0
BALL_BASE_MM = np.array([310.0, -40.0, 85.0])


def euler(tilt_x_deg: float, tilt_y_deg: float) -> np.ndarray:
    about_y = cv2.Rodrigues(np.array([0.0, np.deg2rad(tilt_y_deg), 0.0]))[0]
    return about_y @ cv2.Rodrigues(np.array([np.deg2rad(tilt_x_deg), 0.0, 0.0]))[0]


RIGHT_PLACE = np.array([66.0, 1.0, 4.0])
RIGHT_AXES = euler(0.6, -23.0)


def sheet_normals(kind: str) -> list[np.ndarray]:
    """Normals of planes through the emitter: ``single``, ``cross`` or ``multi`` (5)."""
    along = (MIDDLE - EMITTER) / np.linalg.norm(MIDDLE - EMITTER)
    upright = np.cross(along, [0.0, 1.0, 0.03])
    upright = upright / np.linalg.norm(upright)
    if kind == "single":
        return [upright]
    if kind == "cross":
        return [cv2.Rodrigues(np.deg2rad(a) * along)[0] @ upright for a in (-38.0, 41.0)]
    return [
        cv2.Rodrigues(np.deg2rad(a) * np.array([0.0, 1.0, 0.0]))[0] @ upright
        for a in (-7.2, -3.3, 0.2, 3.5, 7.4)
    ]


def camera_rays(*, is_right: bool) -> tuple[np.ndarray, np.ndarray]:
    step = np.arange(OVERSAMPLING * max(WIDTH, HEIGHT)) + 0.5
    u = step[: OVERSAMPLING * WIDTH] / OVERSAMPLING - 0.5
    v = step[: OVERSAMPLING * HEIGHT] / OVERSAMPLING - 0.5
    x, y = np.meshgrid((u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    if is_right:
        return RIGHT_PLACE, rays @ RIGHT_AXES.T
    return np.zeros(3), rays


def develop(light: np.ndarray, seed: int, noise: float) -> np.ndarray:
    image = light.reshape(HEIGHT, OVERSAMPLING, WIDTH, OVERSAMPLING).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    image = image + noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.clip(image + 5.0, 0, 255).astype(np.uint8)


def with_sheets(light: np.ndarray, albedo: np.ndarray, points: np.ndarray, kind: str) -> np.ndarray:
    light = 0.35 * light
    for normal in sheet_normals(kind):
        light = light + 150.0 * albedo * np.exp(-0.5 * (((points - EMITTER) @ normal) / 0.4) ** 2)
    return light


def board(
    place: tuple[float, float, float], *, kind: str = "", is_plain: bool = False,
    is_right: bool = False, noise: float = 0.5, rings: tuple[tuple[float, float], ...] = (),
) -> np.ndarray:  # fmt: skip
    """Chessboard, plain plate or plate with ring markers, its middle on the left optical axis."""
    tilt_x, tilt_y, z_mm = place
    rotation = euler(tilt_x, tilt_y)
    origin, rays = camera_rays(is_right=is_right)
    reach = ((np.array([0, 0, z_mm]) - origin) @ rotation[:, 2]) / (rays @ rotation[:, 2])
    points = origin + rays * reach[..., None]
    on_board = (points - [0.0, 0.0, z_mm]) @ rotation
    albedo = np.ones(on_board.shape[:2])
    i = on_board[..., 0] / SQUARE_MM + (COLUMNS - 1) / 2
    j = on_board[..., 1] / SQUARE_MM + (ROWS - 1) / 2
    is_on = (i > -1) & (i < COLUMNS) & (j > -1) & (j < ROWS)
    if rings:
        for x, y in rings:
            radius = np.hypot(on_board[..., 0] - x, on_board[..., 1] - y)
            albedo[(radius < 3.0) & (radius > 1.8)] = 0.15
    elif not is_plain:
        albedo[is_on & ((np.floor(i) + np.floor(j)) % 2 == 0)] = 0.25
    light = 130.0 * albedo
    if kind:
        light = with_sheets(light, albedo, points, kind)
    seed = int(1000 + 7 * tilt_x + tilt_y) + (500 if is_right else 0)
    return develop(light, seed, noise)


def ball(centre: np.ndarray, seed: int) -> np.ndarray:
    """A ball in the single sheet; nothing behind it."""
    _, rays = camera_rays(is_right=False)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    along = unit @ centre
    inside = BALL_RADIUS_MM**2 - (centre @ centre - along**2)
    is_hit = inside > 0
    points = unit * (along - np.sqrt(np.maximum(inside, 0.0)))[..., None]
    normal = (points - centre) / BALL_RADIUS_MM
    to_light = EMITTER - points
    to_light = to_light / np.linalg.norm(to_light, axis=-1, keepdims=True)
    shade = np.clip((normal * to_light).sum(-1), 0.0, 1.0) * is_hit
    light = with_sheets(60.0 * is_hit, shade, points, "single")
    return develop(light, seed, 0.5)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 90] if path.suffix == ".jpg" else []
    if not cv2.imwrite(str(path), image, quality):
        raise SystemExit(path)


ARM_HEADER = "t_ns,x_mm,y_mm,z_mm," + ",".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))


def session(kind: str, n_cameras: int, pose: str = "matrix") -> str:
    one = f"[[camera]]\nwidth_px = {WIDTH}\nheight_px = {HEIGHT}\n"
    form = f'[pose]\nform = "{pose}"\n' if pose else ""
    return f'kind = "{kind}"\n{form}[time]\nclock = "shared"\n' + one * n_cameras


def arm_rows(t_ns: int, rotation: np.ndarray, place: np.ndarray, velocity: np.ndarray) -> list[str]:
    rows = []
    for shift in (-(10**7), 10**7):
        at = place + velocity * shift * 1e-9
        numbers = ",".join(f"{value:.12g}" for value in [*at, *rotation.ravel()])
        rows.append(f"{t_ns + shift},{numbers}")
    return rows


def base_from_tool(place: tuple[float, float, float], k: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of the tool for one image of the plate; ``k`` turns it on the plate."""
    along = np.cross(PLATE, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(PLATE, [0.0, 1.0, 0.0]))
    plate_axes = np.column_stack([along, -np.cross(PLATE, along), -PLATE])
    middle = -PLATE_D_MM * PLATE + 20.0 * np.cos(k) * plate_axes[:, 0]
    base_from_sensor = cv2.Rodrigues(0.8 * k * PLATE)[0] @ plate_axes @ euler(*place[:2]).T
    sensor_place = middle - base_from_sensor @ [0.0, 0.0, place[2]]
    rotation = base_from_sensor @ TOOL_FROM_SENSOR_R.T
    return rotation, sensor_place - rotation @ TOOL_FROM_SENSOR_T


def recording(folder: Path, session_text: str, exposures: list[str], arm: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "session.toml").write_text(session_text)
    (folder / "exposures.csv").write_text("\n".join(exposures) + "\n")
    if arm:
        (folder / "arm.csv").write_text("\n".join(arm) + "\n")


EXPOSURES = "index,t_ns,camera,file,lasers,view"


def draw_plate_postures(folder: Path, random: np.random.Generator) -> None:
    exposures, arm = [EXPOSURES], [ARM_HEADER]
    for k, place in enumerate(POSTURES):
        image = board(place, kind="single", is_plain=True, noise=0.3)
        write(folder / "images" / f"{k}.jpg", image)
        time = 10**9 * (k + 1)
        exposures.append(f"{k},{time},0,images/{k}.jpg,A,p{k}")
        rotation, at = base_from_tool(place, k)
        arm += arm_rows(time, rotation, at + 0.01 * random.normal(size=3), np.zeros(3))
    recording(folder, session("calibration", 1), exposures, arm)


def draw_ball(folder: Path, random: np.random.Generator, *, is_at_rest: bool) -> None:
    """Sphere postures at rest (for the hand-eye), or two moving strokes over the ball."""
    exposures, arm = [EXPOSURES[:-5] + (",view" if is_at_rest else "")], [ARM_HEADER]
    plan = []
    if is_at_rest:
        for k, (a, b, z) in enumerate(POSTURES):
            for x in (-3.0, 2.5):
                centre = np.array([x, 1.0 * np.cos(k), z])
                plan.append((1.1 * k, a, b, centre, np.zeros(3), len(plan)))
    else:
        for k in range(14):
            a, b, turn = ((6.0, -9.0, 0.2), (-12.0, 8.0, 1.3))[k // 7]
            centre = np.array([8.4 - 2.8 * (k % 7), 0.4, 148.0])
            plan.append((turn, a, b, centre, np.array([-28.0, 0, 0]), k))
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    for k, (turn, a, b, centre, velocity, view) in enumerate(plan):
        base_from_sensor = cv2.Rodrigues(turn * np.array([0, 0, 1.0]))[0] @ down @ euler(a, b).T
        rotation = base_from_sensor @ TOOL_FROM_SENSOR_R.T
        at = BALL_BASE_MM - base_from_sensor @ centre - rotation @ TOOL_FROM_SENSOR_T
        at = at + 0.004 * random.normal(size=3)
        time = 10**9 + (10**9 * k if is_at_rest else 10**8 * k + 10**9 * (k // 7))
        write(folder / "images" / f"{k}.jpg", ball(centre, k))
        exposures.append(f"{k},{time},0,images/{k}.jpg,A" + (f",s{view}" if is_at_rest else ""))
        arm += arm_rows(time, rotation, at, -base_from_sensor @ velocity)
    recording(folder, session("calibration" if is_at_rest else "scan", 1), exposures, arm)


def draw_two_cameras(folder: Path) -> None:
    """Boards in five sheets, seen by both cameras, and a plate for points."""
    exposures = [EXPOSURES]
    n = 0
    for k, place in enumerate(MULTI_PLACES):
        for lasers in ("", "S1+S2+S3+S4+S5"):
            for camera in (0, 1):
                name = f"images/{'on' if lasers else 'off'}{camera}_{k}.jpg"
                kind = "multi" if lasers else ""
                write(folder / name, board(place, kind=kind, is_right=camera == 1))
                time = 10**9 + 10**9 * k + (10**8 if lasers else 0)
                exposures.append(f"{n},{time},{camera},{name},{lasers},v{k}")
                n += 1
    recording(folder, session("calibration", 2, ""), exposures, [])
    for camera in (0, 1):
        image = board((-6, 9, 148.0), kind="multi", is_plain=True, is_right=camera == 1)
        write(INPUTS / "plain" / f"multi{camera}.jpg", image)


def write_profiles(folder: Path, random: np.random.Generator) -> None:
    """Profiles of a ball of 80 mm, as a sensor delivers them, and the robot's poses."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = []
    for k in range(14):
        a, b = 24.0 * np.cos(1.9 * k), 22.0 * np.sin(2.3 * k)
        tool = cv2.Rodrigues(0.35 * k * np.array([0, 0, 1.0]))[0]
        tool = tool @ np.diag([1.0, -1.0, -1.0]) @ euler(a, b)
        centre = np.array([4.0 * np.cos(k), 11.0 * np.sin(1.3 * k), 175.0 + 6.0 * np.sin(k)])
        circle = np.sqrt(40.0**2 - centre[1] ** 2)
        angle = np.linspace(-0.9, 0.9, 60)
        x, z = centre[0] + circle * np.sin(angle), centre[2] - circle * np.cos(angle)
        z = z + 0.02 * random.normal(size=z.size)
        rows = [f"{p:.6f},{q:.6f}" for p, q in zip(x, z, strict=True)]
        (folder / f"p{k:02d}.csv").write_text("x_mm,z_mm\n" + "\n".join(rows) + "\n")
        rotation = tool @ TOOL_FROM_SENSOR_R.T @ np.eye(3)
        at = np.array([900.0, 120.0, 40.0]) - tool @ centre - rotation @ TOOL_FROM_SENSOR_T
        # extrinsic xyz: R = Rz(c) Ry(b) Rx(a)
        turn_b = -np.arcsin(rotation[2, 0])
        turn_a = np.arctan2(rotation[2, 1], rotation[2, 2])
        turn_c = np.arctan2(rotation[1, 0], rotation[0, 0])
        numbers = [*at, *np.rad2deg([turn_a, turn_b, turn_c])]
        poses.append(" ".join(f"{value:.6f}" for value in numbers))
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")


def write_tables(folder: Path, random: np.random.Generator) -> None:
    """Clouds, touches and lists of markers: plain tables."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y = random.uniform(-30, 30, (2, 600))
    z = 5.0 + 0.02 * x - 0.01 * y + 0.015 * random.normal(size=x.size)
    table(folder / "plane.xyz", np.column_stack([x, y, z]), " ")
    step = np.where(x > 0, 20.0, 0.0) + 0.015 * random.normal(size=x.size)
    table(folder / "step.csv", np.column_stack([x + 4.0 * np.sign(x), y, step]), ",", "x,y,z\n")
    up = np.arccos(random.uniform(0.35, 1.0, 900))
    around = random.uniform(0, 2 * np.pi, 900)
    unit = np.column_stack([np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)])
    points = (17.48 + 0.01 * random.normal(size=(900, 1))) * unit + [10.0, -5.0, 60.0]
    points[:12] += 0.6 * unit[:12]
    table(folder / "ball.xyz", points, " ")
    touches = np.column_stack([random.uniform(-80, 80, (24, 2)), np.zeros(24)])
    touches[:, 2] = -(touches[:, :2] @ PLATE[:2] + PLATE_D_MM) / PLATE[2]
    touches += 0.004 * random.normal(size=touches.shape)
    table(folder / "plate.csv", touches, ",", "x_mm,y_mm,z_mm\n")
    head = "# point = tip-centre, tip_diameter_mm = 6\nx_mm,y_mm,z_mm\n"
    centres = touches + 3.0 * PLATE
    table(folder / "centres.csv", centres, ",", head)
    centres[5] += 0.4 * PLATE
    table(folder / "centres_bad.csv", centres, ",", head)
    markers = np.column_stack([random.uniform(-100, 100, (18, 2)), random.uniform(0, 40, 18)])
    for k, part in enumerate((slice(0, 10), slice(4, 14), slice(8, 18))):
        turn = cv2.Rodrigues(np.array([0.1, -0.2, 0.5]) * k)[0]
        seen = (markers[part] - [5.0 * k, 3.0, 0]) @ turn.T + [0, 0, 200.0]
        seen += 0.01 * random.normal(size=seen.shape)
        table(folder / f"view{k + 1}.csv", seen, ",", "x_mm,y_mm,z_mm\n")
        table(folder / f"view{k + 1}.xyz", seen + np.array([0, 0, 1.0]), " ")
    for name, angle, shift in (("before", 0.0, 0.0), ("after", 0.7, 250.0)):
        seen = markers @ cv2.Rodrigues(np.array([0.05, 0.0, 1.0]) * angle)[0].T + [shift, 0, 0]
        seen = seen + 0.01 * random.normal(size=seen.shape)
        table(folder / f"{name}.csv", seen, ",", "x_mm,y_mm,z_mm,id\n", has_ids=True)


def table(
    path: Path, rows: np.ndarray, comma: str, head: str = "", *, has_ids: bool = False
) -> None:
    lines = [comma.join(f"{v:.6f}" for v in row) for row in rows]
    if has_ids:
        lines = [f"{line}{comma}{k + 1}" for k, line in enumerate(lines)]
    path.write_text(head + "\n".join(lines) + "\n")


def main() -> None:
    random = np.random.default_rng(20)
    for k, tilts in enumerate(CAMERA_TILTS):
        for name, is_right in (("left", False), ("right", True)):
            image = board((*tilts, 150.0 + 3 * k), is_right=is_right)
            write(INPUTS / name / f"view{k}.jpg", image)
    for k, place in enumerate(LASER_PLACES):
        for name, kind in (("off", ""), ("on", "single"), ("cross", "cross")):
            write(INPUTS / name / f"place{k}.jpg", board(place, kind=kind))
    for name, kind in (("dark", ""), ("single", "single"), ("cross", "cross")):
        write(INPUTS / "plain" / f"{name}.jpg", board((15, 20, 150.0), kind=kind, is_plain=True))
    rings = (
        (-22, -14),
        (-8, -17),
        (9, -13),
        (24, -15),
        (-20, 4),
        (2, 1),
        (19, 6),
        (-6, 16),
        (13, 18),
    )
    for name, is_right in (("rings0", False), ("rings1", True)):
        write(
            INPUTS / "plain" / f"{name}.jpg", board((9, -7, 150.0), rings=rings, is_right=is_right)
        )
    draw_plate_postures(INPUTS / "plate-scan", random)
    draw_ball(INPUTS / "ball-rest", random, is_at_rest=True)
    draw_ball(INPUTS / "ball-scan", random, is_at_rest=False)
    draw_two_cameras(INPUTS / "two-cameras")
    write_profiles(INPUTS / "profiles", random)
    write_tables(INPUTS / "tables", random)


if __name__ == "__main__":
    main()
