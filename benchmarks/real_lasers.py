# SPDX-License-Identifier: Apache-2.0
"""Light sheets from photographs of strangers: ours against forty lines of OpenCV.

    python benchmarks/real_lasers.py ROOT [SET ...] [--out FOLDER] [--tree SRC] [--images]

ROOT holds the repositories of `laser_sets.py`. SRC is the ``src`` folder whose armscan is measured
(default: this tree). The script's detections of targets are kept in FOLDER, and the table goes to
``FOLDER/LABEL.md``. Nothing is random.

Both are judged alike, by numpy and OpenCV here, not by numbers that they state. A point is where
the ray of a stripe's pixel meets the sheet, both of the document that was written; its error is its
distance from the plane of the board in that photograph, mm. The board's plane is `solvePnP` of the
target's points with the camera of the document.

Columns
  boards        with a line found by the script / by either; then script's and ours' used ones
  points        stripe points used
  leave-one-out rms (median) of the points of each used board with the sheet of all the others;
                beyond 24 boards, 24 groups of boards. Each with its own target points. *all*:
                boards that were named outliers count too. *same points*: those that both used.
  own           mean and rms of the calibration's own stripes with the document as written, and
                their rms over the claimed sigma along the board's normal
  kept          the script's inlier points within 1.5 px of a used point of ours
  off           points of ``armscan reconstruct`` inside the target's rectangle (one square around
                it) that lie farther off the board than the smaller of 5 sigma and 1 mm; the board
                there is the one that OpenCV found; then those beyond 5 sigma alone
  time          processor time of ours over the script's: camera and sheets, programs loaded
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import forty_lines as script
import numpy as np
from laser_sets import SETS, LaserSet
from scipy.spatial import cKDTree

Array = Any
HERE = Path(__file__).resolve().parent
FOLDS = 24
TABLE_MARK = "<!-- table: written by benchmarks/real_lasers.py -->"
TABLE_END = "<!-- end of table -->"
BOW_TERMS = ("u2_v0", "u1_v1", "u0_v2", "u3_v0", "u2_v1")
NEAR_PX = 1.5
MIN_POINTS = 20


@dataclass
class BoardView:
    """One photograph of a side: target points, stripe points of each sheet, and what was kept."""

    view_px: Array
    view_mm: Array
    pose: Any
    lines: dict[int, Array] = field(default_factory=dict)
    kept: dict[int, Array] = field(default_factory=dict)

    def n_kept(self) -> int:
        """Count of points that went into the sheets."""
        return int(sum(keep.sum() for keep in self.kept.values()))


@dataclass
class Side:
    """What one program made of a set; sheets are functions of rays."""

    camera: Any
    boards: dict[str, BoardView]
    sheets: dict[int, Any]
    folds: list[tuple[set[str], Any, dict[int, Any]]]
    cpu_seconds: float
    failure: str = ""
    notes: dict[str, str] = field(default_factory=dict)

    def used(self) -> set[str]:
        """Photographs at least half of whose points went into the sheets."""
        return {
            name
            for name, board in self.boards.items()
            if board.n_kept() >= max(MIN_POINTS, 0.5 * sum(map(len, board.lines.values())))
        }


def is_fisheye(camera: Any) -> bool:
    """Matrix and the four terms of `cv2.fisheye`; a pinhole has five coefficients here."""
    return bool(np.size(camera[1]) == 4)


def rays_of(pixels: Array, camera: Any) -> Array:
    """(N, 3) rays by an inverse of the lens that is iterated to the end."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    points = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
    invert = cv2.fisheye.undistortPoints if is_fisheye(camera) else cv2.undistortPoints
    xy = invert(points, *camera, criteria=criteria).reshape(-1, 2)
    return np.column_stack([xy, np.ones(len(xy))])


def pixels_of(points: Array, camera: Any) -> Array:
    """(N, 2) pixels of points (N, 3) before the camera."""
    project = cv2.fisheye.projectPoints if is_fisheye(camera) else cv2.projectPoints
    return project(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), *camera)[0].reshape(-1, 2)


def board_distance(points: Array, pose: Any) -> Array:
    """(N,) mm along the board's normal."""
    return (points - pose[1]) @ pose[0][:, 2]


def pose_of(pixels: Array, points_mm: Array, camera: Any) -> Any:
    """Rotation and translation of a board by `solvePnP`."""
    flat = np.column_stack([np.asarray(points_mm)[:, :2], np.zeros(len(points_mm))])
    pixels = np.asarray(pixels, dtype=float)
    if is_fisheye(camera):
        pixels, camera = rays_of(pixels, camera)[:, :2].copy(), (np.eye(3), np.zeros(5))
    _, rotation, translation = cv2.solvePnP(flat, pixels, *camera)
    return cv2.Rodrigues(rotation)[0], translation.ravel()


# --------------------------------------------------------------------------- the script's side
class Detections:
    """Targets that the script found, with their processor time, kept in a file of its own."""

    def __init__(self, folder: Path, photos: LaserSet) -> None:
        self.board = script.Board.of(photos.target)
        detector = inspect.getsource(script.find_board)
        key = hashlib.sha256((detector + photos.target).encode()).hexdigest()[:12]
        self.path = folder / f"boards-{photos.repository.split('/')[1]}-{key}.pickle"
        stored = self.path.read_bytes() if self.path.is_file() else b""
        self.found: dict[str, Any] = pickle.loads(stored) if stored else {}  # our own file
        self.cpu_seconds = 0.0

    def find(self, path: Path, image: Array) -> Array | None:
        """(N, 2) px or None."""
        if str(path) not in self.found:
            began = time.process_time()
            view = script.find_board(image, self.board)
            self.found[str(path)] = (view, time.process_time() - began)
        view, seconds = self.found[str(path)]
        self.cpu_seconds += seconds
        return view

    def write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_bytes(pickle.dumps(self.found))


def script_findings(photos: LaserSet, root: Path, cache: Path) -> dict[str, Any]:
    """Camera, boards and lines of the script, with its processor time."""
    detections, board = Detections(cache, photos), script.Board.of(photos.target)
    own_seconds = 0.0
    views, size = [], (0, 0)
    for path in photos.files(root, photos.camera):
        image = cv2.imread(str(path))
        size = image.shape[1::-1]
        found = detections.find(path, image)
        if found is not None:
            views.append(found)
    began = time.process_time()
    rms, matrix, distortion = script.calibrate_camera(views, board, size)
    own_seconds += time.process_time() - began
    camera = (matrix, distortion)
    on, off = photos.files(root, photos.on), photos.files(root, photos.off)
    boards, notes = {}, {}
    for k, path in enumerate(on):
        image = cv2.imread(str(path))
        dark = cv2.imread(str(off[k])) if off else None
        view = detections.find(path if dark is None else off[k], image if dark is None else dark)
        if view is None and dark is not None:
            view = detections.find(path, image)
        if view is None:
            notes[path.name] = "no board"
            continue
        began = time.process_time()
        pose = script.board_pose(view, board, *camera)
        mask = script.board_mask(pose, board, camera, image.shape, photos.margin_mm)
        channel, lines = script.find_lines(image, dark, mask, camera, photos.n_lines)
        own_seconds += time.process_time() - began
        if len(lines) != photos.n_lines:
            notes[path.name] = f"{len(lines)} lines of {photos.n_lines} in {channel}"
            lines = []
        else:
            notes[path.name] = f"{sum(map(len, lines))} points in {channel}"
        boards[path.name] = (view, pose, lines)
    detections.write()
    return {
        "camera": camera,
        "camera_rms_px": rms,
        "size": size,
        "boards": boards,
        "notes": notes,
        "cpu_seconds": own_seconds + detections.cpu_seconds,
    }


def plane_meeter(plane: Array) -> Any:
    return lambda directions: script.meet_plane(directions, plane)


def script_planes(boards: dict[str, BoardView], camera: Any) -> tuple[dict[int, Any], Any]:
    """Sheets through the points of all boards, and which points of each board were kept."""
    sheets: dict[int, Any] = {}
    kept: dict[str, dict[int, Array]] = {name: {} for name in boards}
    for sheet in sorted({s for board in boards.values() for s in board.lines}):
        names = [name for name, board in boards.items() if sheet in board.lines]
        points = [
            script.meet_plane(
                script.rays(boards[name].lines[sheet], camera),
                script.plane_of_pose(boards[name].pose),
            )
            for name in names
        ]
        plane, keep = script.fit_plane(np.concatenate(points))
        sheets[sheet] = plane_meeter(plane)
        parts = np.split(keep, np.cumsum([len(part) for part in points])[:-1])
        for name, part in zip(names, parts, strict=True):
            kept[name][sheet] = part
    return sheets, kept


def script_side(photos: LaserSet, found: dict[str, Any]) -> Side:
    began = time.process_time()
    camera = found["camera"]
    target = script.Board.of(photos.target)
    boards = {
        name: BoardView(view, target.points_mm, pose, dict(enumerate(lines)))
        for name, (view, pose, lines) in found["boards"].items()
        if lines
    }
    if not boards:
        return Side(camera, {}, {}, [], found["cpu_seconds"], "no lines", found["notes"])
    sheets, kept = script_planes(boards, camera)
    seconds = found["cpu_seconds"] + time.process_time() - began
    for name, board in boards.items():
        board.kept = kept[name]
    folds = []
    names = sorted(boards)
    for k in range(min(FOLDS, len(names))):
        left = set(names[k::FOLDS])
        others = {name: board for name, board in boards.items() if name not in left}
        if others:
            folds.append((left, camera, script_planes(others, camera)[0]))
    return Side(camera, boards, sheets, folds, seconds, "", found["notes"])


# --------------------------------------------------------------------------- our side
def camera_of(document: dict[str, Any]) -> Any:
    values = document["camera"]["intrinsics"]
    fx, fy, cx, cy = (values[f"{name}_px"] for name in ("fx", "fy", "cx", "cy"))
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if values["model"].startswith("fisheye"):
        return matrix, np.array([*(values[name] for name in ("k1", "k2", "k3")), 0.0])
    return matrix, np.array([values[name] for name in ("k1", "k2", "p1", "p2", "k3")])


def sheet_meeter(sheet: dict[str, Any]) -> Any:
    """Where rays meet a plane with a bow, by steps along the ray."""
    origin = np.array(sheet["origin_sensor_mm"])
    axes = np.array([sheet["axes"][f"{name}_sensor"] for name in ("u", "v", "normal")])
    bow = [sheet["bow_mm"][name] for name in BOW_TERMS]
    powers = [(int(name[1]), int(name[4])) for name in BOW_TERMS]

    def meet(directions: Array) -> Array:
        steepness = directions @ axes[2]
        depth = origin @ axes[2] / steepness
        for _ in range(30):
            local = (directions * depth[:, None] - origin) @ axes.T
            u, v = local[:, 0] / sheet["scale_mm"], local[:, 1] / sheet["scale_mm"]
            bowed = sum(b * u**i * v**j for b, (i, j) in zip(bow, powers, strict=True))
            height = local[:, 2] - bowed
            depth = depth - height / steepness
        return directions * depth[:, None]

    return meet


def sheets_of(document: dict[str, Any]) -> dict[int, Any]:
    return {k: sheet_meeter(sheet) for k, sheet in enumerate(document["sheets"])}


def our_side(folder: Path) -> Side:
    stored = folder / "ours.json"
    if not stored.is_file():
        return Side(None, {}, {}, [], 0.0, "not run")
    result = json.loads(stored.read_text(encoding="utf-8"))
    seconds = sum(result.get(stage, {}).get("cpu_seconds", 0.0) for stage in ("camera", "laser"))
    if "document" not in result:
        stage = "laser" if "laser" in result else "camera"
        return Side(None, {}, {}, [], seconds, f"{stage}: {result.get('said', 'refused')}")
    document = result["document"]
    camera = camera_of(document)
    data = np.load(folder / "boards.npz")
    on_board = ~np.isin(data["use"], ("FLAGGED", "NO_RAY", "OFF_BOARD", "OFF_LINE", "ON_EDGE"))
    boards: dict[str, BoardView] = {}
    for k, name in enumerate(data["source"]):
        seen = data["view_image"] == k
        view, points = data["view_px"][seen], data["view_mm"][seen]
        board = BoardView(view, points, pose_of(view, points, camera))
        own = (data["point_image"] == k) & on_board
        for sheet in np.unique(data["sheet"][own]):
            line = own & (data["sheet"] == sheet)
            board.lines[max(int(sheet), 0)] = data["points_px"][line]
            board.kept[max(int(sheet), 0)] = data["use"][line] == "USED"
        if board.lines:
            boards[str(name)] = board
    folds = [
        (set(fold["sources"]), camera_of(fold["document"]), sheets_of(fold["document"]))
        for fold in result["folds"]
        if "document" in fold
    ]
    notes = dict(result["skipped"])
    for k, name in enumerate(data["source"]):
        uses, counts = np.unique(data["use"][data["point_image"] == k], return_counts=True)
        notes[str(name)] = ", ".join(f"{n} {u}" for u, n in zip(uses, counts, strict=True))
    return Side(camera, boards, sheets_of(document), folds, seconds, "", notes)


def run_ours(name: str, root: Path, folder: Path, tree: Path, *options: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(tree), "OPENCV_LOG_LEVEL": "ERROR"}
    command = [sys.executable, str(HERE / "real_lasers_ours.py"), name, str(root), str(folder)]
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [*command, *options],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    (folder / "said.txt").write_text(done.stdout + done.stderr, encoding="utf-8")
    stored = folder / "ours.json"
    result = json.loads(stored.read_text(encoding="utf-8")) if stored.is_file() else {}
    if "document" not in result:
        words = [line for line in done.stderr.splitlines() if line.strip()]
        result["said"] = words[-1] if words else "no word"
        stored.write_text(json.dumps(result), encoding="utf-8")


# --------------------------------------------------------------------------- the judge
@dataclass
class Errors:
    """Distances from boards, mm."""

    values: Array

    def __str__(self) -> str:
        if not len(self.values):
            return "-"
        return f"{self.rms:.3f} ({self.median:.3f})"

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.values**2)))

    @property
    def median(self) -> float:
        return float(np.median(np.abs(self.values)))


def kept_points(board: BoardView) -> Array:
    """(N, 2) px of the stripe points that were used, of all sheets."""
    return np.concatenate([np.zeros((0, 2)), *(board.lines[s][board.kept[s]] for s in board.lines)])


def left_out(
    side: Side, names: set[str], *, is_all: bool = False, shared: Side | None = None
) -> Errors:
    """Points of boards with the sheets of the others; only those that another side used, too."""
    values = [np.zeros(0)]
    for left, camera, sheets in side.folds:
        for name in left & names & set(side.boards):
            board = side.boards[name]
            pose = pose_of(board.view_px, board.view_mm, camera)
            for sheet, line in board.lines.items():
                if sheet not in sheets:
                    continue
                points = line if is_all else line[board.kept[sheet]]
                if shared is not None:
                    theirs = kept_points(shared.boards[name])
                    points = points[cKDTree(theirs).query(points)[0] < NEAR_PX]
                if len(points):
                    met = sheets[sheet](rays_of(points, camera))
                    values.append(board_distance(met, pose))
    return Errors(np.concatenate(values))


def own_errors(side: Side) -> Errors:
    """The calibration's own stripes with the document as written."""
    values = [np.zeros(0)]
    for name in side.used():
        board = side.boards[name]
        for sheet, line in board.lines.items():
            if sheet in side.sheets and board.kept[sheet].any():
                met = side.sheets[sheet](rays_of(line[board.kept[sheet]], side.camera))
                values.append(board_distance(met, board.pose))
    return Errors(np.concatenate(values))


def read_cloud(path: Path) -> tuple[Array, list[str]]:
    """Vertices of a binary PLY as a structured array, and the sources of its exposures."""
    data = path.read_bytes()
    header, _, body = data.partition(b"end_header\n")
    kinds = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1", "uint": "<u4"}
    fields, sources = [], []
    for line in header.decode().splitlines():
        words = line.split()
        if words[0] == "property":
            fields.append((words[2], kinds[words[1]]))
        if words[:2] == ["comment", "exposure"]:
            sources.append(json.loads(line.split(maxsplit=3)[3]))
    return np.frombuffer(body, dtype=fields), sources


@dataclass
class Cloud:
    """What the reconstruction of the calibration's photographs gave."""

    n_on_board: int = 0
    n_off: int = 0
    n_beyond_5_sigma: int = 0
    worst_mm: float = 0.0
    own: Errors = field(default_factory=lambda: Errors(np.zeros(0)))
    own_sigmas: Errors = field(default_factory=lambda: Errors(np.zeros(0)))
    sigma_mm: float = 0.0
    off_by_image: dict[str, str] = field(default_factory=dict)


def judge_cloud(folder: Path, ours: Side, theirs: dict[str, Any], photos: LaserSet) -> Cloud:
    """Points on the boards' pixels, and the claimed sigma of the calibration's own stripes."""
    if not (folder / "cloud.ply").is_file() or ours.camera is None:
        return Cloud()
    vertices, sources = read_cloud(folder / "cloud.ply")
    points = np.column_stack([vertices[k] for k in "xyz"])
    pixels = pixels_of(points, ours.camera)
    target = script.Board.of(photos.target)
    pitch = float(np.diff(np.unique(target.points_mm[:, 0])).min())
    margin = np.minimum(photos.margin_mm, pitch)
    cloud, own, sigmas, claimed = Cloud(), [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for k, source in enumerate(sources):
        mine = vertices["exposure"] == k
        variance = np.stack(
            [vertices[f"cov_{c}_mm2"][mine] for c in ("xx", "xy", "xz", "yy", "yz", "zz")], 1
        )
        covariance = variance[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        if source in theirs["boards"]:
            view = theirs["boards"][source][0]
            pose = pose_of(view, target.points_mm, ours.camera)
            shape = theirs["size"][::-1]
            mask = script.board_mask(pose, target, ours.camera, shape, margin)
            x, y = np.clip(np.round(pixels[mine]).astype(int), 0, np.array(shape)[::-1] - 1).T
            inside = mask[y, x]
            distance = np.abs(board_distance(points[mine], pose))[inside]
            normal = pose[0][:, 2]
            sigma = np.sqrt(np.einsum("i,nij,j->n", normal, covariance, normal))[inside]
            is_off = distance > np.minimum(5 * sigma, 1.0)
            cloud.n_on_board += len(distance)
            cloud.n_off += int(is_off.sum())
            cloud.n_beyond_5_sigma += int((distance > 5 * sigma).sum())
            if is_off.any():
                cloud.off_by_image[source] = f"{is_off.sum()} of {len(distance)} off"
                cloud.worst_mm = max(cloud.worst_mm, float(distance.max()))
        if source in ours.used():
            board = ours.boards[source]
            near = cKDTree(kept_points(board)).query(pixels[mine])[0] < NEAR_PX
            normal = board.pose[0][:, 2]
            sigma = np.sqrt(np.einsum("i,nij,j->n", normal, covariance[near], normal))
            distance = board_distance(points[mine][near], board.pose)
            own.append(distance)
            sigmas.append(distance / sigma)
            claimed.append(sigma)
    cloud.own, cloud.own_sigmas = Errors(np.concatenate(own)), Errors(np.concatenate(sigmas))
    cloud.sigma_mm = Errors(np.concatenate(claimed)).rms if len(claimed) > 1 else 0.0
    return cloud


def kept_share(ours: Side, theirs: Side) -> float:
    """Share of the script's inlier points that ours used, too."""
    n = n_near = 0
    for name in theirs.used():
        board = theirs.boards[name]
        points = kept_points(board)
        n += len(points)
        if name in ours.boards:
            used = kept_points(ours.boards[name])
            if len(used):
                n_near += int((cKDTree(used).query(points)[0] < NEAR_PX).sum())
    return n_near / n if n else float("nan")


HEADINGS = (
    "set",
    "boards either, script, ours",
    "points script, ours",
    "left out: script",
    "left out: ours",
    "all: script",
    "all: ours",
    "same points: script",
    "same points: ours",
    "own mean, rms mm (rms/sigma)",
    "kept %",
    "off %, 5 sigma % (of)",
    "time",
)


def judge(name: str, photos: LaserSet, theirs: Side, ours: Side, cloud: Cloud) -> list[str]:
    """One row of the table."""
    script_used, our_used = theirs.used(), ours.used()
    either = set(theirs.boards) | set(ours.boards)
    n_points = [sum(side.boards[b].n_kept() for b in side.used()) for side in (theirs, ours)]
    both = script_used & our_used
    held = " (held out)" if photos.is_held_out else ""
    row = [name + held, f"{len(either)}, {len(script_used)}, {len(our_used)}"]
    row += [f"{n_points[0]}, {n_points[1]}", str(left_out(theirs, script_used))]
    if ours.failure:
        ratio = f"{ours.cpu_seconds:.0f} / {theirs.cpu_seconds:.0f} s"
        return [*row, ours.failure[:60], *["-"] * (len(HEADINGS) - 6), ratio]
    own = own_errors(ours)
    mean = float(own.values.mean()) if len(own.values) else float("nan")
    sigmas = f"{cloud.own_sigmas.rms:.2f}" if len(cloud.own_sigmas.values) else "-"
    row += [str(left_out(ours, our_used))]
    row += [str(left_out(side, set(side.boards), is_all=True)) for side in (theirs, ours)]
    row += [str(left_out(theirs, both, shared=ours)), str(left_out(ours, both, shared=theirs))]
    row += [f"{mean:+.3f}, {own.rms:.3f} ({sigmas})", f"{100 * kept_share(ours, theirs):.0f}"]
    shares = [100 * n / max(cloud.n_on_board, 1) for n in (cloud.n_off, cloud.n_beyond_5_sigma)]
    row += [f"{shares[0]:.1f}, {shares[1]:.1f} ({cloud.n_on_board})"]
    return [*row, f"{ours.cpu_seconds:.0f} / {theirs.cpu_seconds:.0f} s"]


def markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (list(HEADINGS), *rows)]
    lines.insert(1, "|" + " --- |" * len(HEADINGS))
    return "\n".join(lines) + "\n"


def show_images(photos: LaserSet, root: Path, theirs: Side, ours: Side, cloud: Cloud) -> None:
    for path in photos.files(root, photos.on):
        source = path.name
        marks = "".join(
            "*" if source in side.used() else "-" if source in side.boards else " "
            for side in (theirs, ours)
        )
        said = ours.notes.get(source, ours.failure or "nothing")
        off = cloud.off_by_image.get(source, "")
        print(f"  {marks} {source}: script {theirs.notes.get(source, '')} | ours {said} | {off}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("sets", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("real-lasers"))
    parser.add_argument("--tree", type=Path, default=HERE.parent / "src")
    parser.add_argument("--label", default="ours")
    parser.add_argument("--images", action="store_true", help="say what became of each photograph")
    parser.add_argument("--again", action="store_true", help="judge what was run before")
    parser.add_argument("--same-camera", action="store_true", help="ours takes OpenCV's camera")
    parser.add_argument(
        "--keep-camera", action="store_true", help="ours takes its camera of before"
    )
    parser.add_argument("--page", type=Path, help="Markdown page whose table is replaced")
    parser.add_argument("--folds", type=int, default=FOLDS, help="of ours; 0: none, and quick")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    for name in arguments.sets or SETS:
        photos = SETS[name]
        folder = (arguments.out / arguments.label / name).resolve()
        found = script_findings(photos, arguments.root, arguments.out / "script")
        theirs = script_side(photos, found)
        camera = ""
        before = (arguments.out / "camera" / f"{name}.json").resolve()
        if arguments.keep_camera and before.is_file():
            camera = str(before)
        if arguments.same_camera:
            camera = str(write_camera(arguments.out / "script" / f"{name}.yml", found))
        if not arguments.again:
            tree = arguments.tree.resolve()
            options = (str(arguments.folds), *([camera] if camera else []))
            run_ours(name, arguments.root.resolve(), folder, tree, *options)
            if (folder / "camera.json").is_file():
                before.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(folder / "camera.json", before)
        ours = our_side(folder)
        cloud = judge_cloud(folder, ours, found, photos)
        rows.append(judge(name, photos, theirs, ours, cloud))
        print(markdown(rows[-1:]).splitlines()[-1], flush=True)
        if arguments.images:
            show_images(photos, arguments.root, theirs, ours, cloud)
    text = markdown(rows)
    (arguments.out / f"{arguments.label}.md").write_text(text, encoding="utf-8")
    print("\n" + text)
    if arguments.page:
        before, mark, rest = arguments.page.read_text(encoding="utf-8").partition(TABLE_MARK)
        after = rest.partition(TABLE_END)
        page = f"{before}{mark}\n{text}{after[1]}{after[2]}"
        arguments.page.write_text(page, encoding="utf-8")


def write_camera(path: Path, found: dict[str, Any]) -> Path:
    """The script's camera as OpenCV writes it."""
    storage = cv2.FileStorage(str(path.resolve()), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", found["size"][0])
    storage.write("image_height", found["size"][1])
    storage.write("camera_matrix", found["camera"][0])
    storage.write("distortion_coefficients", found["camera"][1])
    storage.release()
    return path.resolve()


if __name__ == "__main__":
    main()
