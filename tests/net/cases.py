# SPDX-License-Identifier: Apache-2.0
"""The commands the net runs: a line each, in groups that do not depend on each other.

Each runs in a folder that holds a copy of ``inputs/``; what one line of a group wrote is there for
the next ones.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

T = "--target chessboard:8x6:6"
D = "documents"


def read_cases() -> dict[str, list[tuple[str, str]]]:
    """Names and commands of ``cases.txt``, group by group."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for line in Path(__file__).with_name("cases.txt").read_text("utf-8").splitlines():
        if line.startswith("["):
            groups[line.strip("[]")] = []
        elif line and not line.startswith("#"):
            name, _, command = line.partition(" | ")
            command = command.replace("<target>", T).replace("<docs>", D)
            groups[list(groups)[-1]].append((name, command))
    return groups


GROUPS = read_cases()
DOCUMENTS = GROUPS.pop("documents")


def prepare(workspace: Path) -> None:
    """Make the wrong files that the refusals need out of the right ones."""
    bad = workspace / "bad"
    (bad / "empty-folder").mkdir(parents=True)
    (bad / "not-image.jpg").write_text("this is no image\n")
    photo = (workspace / "left/view0.jpg").read_bytes()
    (bad / "cut.jpg").write_bytes(photo[: len(photo) // 2])
    import cv2

    cv2.imwrite(str(bad / "small.png"), np.full((60, 80), 90, np.uint8))
    (bad / "shifted-left").mkdir()
    left = sorted((workspace / "left").iterdir())
    for k, path in enumerate(left):
        shutil.copy(left[(k + 3) % len(left)], bad / "shifted-left" / path.name)
    (bad / "two-off").mkdir()
    for path in sorted((workspace / "off").iterdir())[:2]:
        shutil.copy(path, bad / "two-off" / f"other{path.name}")
    _bad_documents(workspace, bad)
    _bad_tables(workspace, bad)
    _bad_recordings(workspace, bad)
    (workspace / "foreign").mkdir()
    camera = json.loads((workspace / D / "camera.json").read_text())["camera"]["intrinsics"]
    f = camera
    (workspace / "foreign/camera_info.yaml").write_text(
        "image_width: 480\nimage_height: 360\ncamera_name: net\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{f['fx_px']}, 0, {f['cx_px']}, 0, "
        f"{f['fy_px']}, {f['cy_px']}, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{f['k1']}, {f['k2']}, "
        f"{f['p1']}, {f['p2']}, {f['k3']}]\n"
    )


def _bad_documents(workspace: Path, bad: Path) -> None:
    text = (workspace / D / "camera.json").read_text()
    document = json.loads(text)
    (bad / "camera-cut.json").write_text(text[: len(text) // 2])
    (bad / "camera-nan.json").write_text(
        text.replace(repr(document["camera"]["intrinsics"]["fx_px"]), "NaN")
    )
    (bad / "camera-newer.json").write_text(json.dumps(document | {"schema_version": 99}))
    (bad / "camera-key.json").write_text(json.dumps(document | {"colour": "blue"}))
    (bad / "camera-twice.json").write_text(text.replace("{", '{"schema_version": 1,', 1))
    document["camera"]["intrinsics"]["width_px"] = 640
    (bad / "camera-size.json").write_text(json.dumps(document))
    text = (workspace / D / "scanner.json").read_text()
    (bad / "scanner-cut.json").write_text(text[:-200])


def _bad_tables(workspace: Path, bad: Path) -> None:
    for name, text in {
        "empty.xyz": "",
        "nan.xyz": "1 2 3\n1 nan 3\n2 2 2\n3 3 1\n",
        "commas.xyz": "1,5 2,5 3,5\n2,5 2,5 1,5\n",
        "two.xyz": "1 2 3\n4 5 6\n",
        "line.xyz": "".join(f"{k} {2 * k} {3 * k}\n" for k in range(40)),
        "empty.csv": "x_mm,y_mm,z_mm\n",
        "nan.csv": "x_mm,y_mm,z_mm\n1,2,3\n4,nan,6\n7,8,1\n1,1,1\n5,2,2\n",
        "no-column.csv": "x_mm,z_mm\n1,2\n3,4\n5,6\n7,9\n",
        "two.csv": "x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n",
        "line.csv": "x_mm,y_mm,z_mm\n" + "".join(f"{k},{2 * k},{3 * k}\n" for k in range(9)),
    }.items():
        (bad / name).write_text(text)
    rows = (workspace / "tables/before.csv").read_text().splitlines()
    rows[3] = rows[3].rpartition(",")[0] + ",1"
    (bad / "twice-id.csv").write_text("\n".join(rows) + "\n")
    cloud = (workspace / D / "ball.ply").read_bytes()
    (bad / "cut.ply").write_bytes(cloud[: len(cloud) // 2])


def _bad_recordings(workspace: Path, bad: Path) -> None:
    def arm(change: Callable[[list[list[str]]], list[list[str]]]) -> Callable[[Path], None]:
        return _edit("arm.csv", change)

    def exposures(change: Callable[[list[list[str]]], list[list[str]]]) -> Callable[[Path], None]:
        return _edit("exposures.csv", change)

    plate: dict[str, Callable[[Path], None]] = {
        "half-scan": exposures(lambda rows: rows[:7]),
        "few-scan": exposures(lambda rows: rows[:3]),
        "no-arm": lambda folder: (folder / "arm.csv").unlink(),
        "nan-arm": arm(lambda rows: [*rows[:5], *_set(rows[5:7], 1, "nan"), *rows[7:]]),
        "text-arm": arm(lambda rows: [*rows[:5], *_set(rows[5:6], 2, "north"), *rows[6:]]),
        "twice-arm": arm(lambda rows: [*rows, rows[-1]]),
        "swapped-arm": arm(lambda rows: [_swapped(rows[0]), *rows[1:]]),
        "no-rotation": arm(lambda rows: [row[:8] for row in rows]),
        "inches": arm(lambda rows: [rows[0], *map(_inches, rows[1:])]),
        "unknown-session": lambda folder: _append(
            folder / "session.toml", "\n[weather]\nsun = 1\n"
        ),
        "missing-image": lambda folder: (folder / "images/4.jpg").unlink(),
        "moved-view": exposures(lambda rows: [rows[0], *_set(rows[1:], -1, "same")]),
    }
    ball: dict[str, Callable[[Path], None]] = {
        "late-arm": arm(lambda rows: [rows[0], *rows[9:]]),
        "other-laser": exposures(lambda rows: [rows[0], *_set(rows[1:], 4, "Q")]),
        "no-time": exposures(lambda rows: [[*row[:1], *row[2:]] for row in rows]),
        "outside-path": exposures(lambda rows: [rows[0], *_set(rows[1:], 3, "../left/view0.jpg")]),
    }
    rest = {"half-ball": exposures(lambda rows: rows[:9])}
    for source, changes in (("plate-scan", plate), ("ball-scan", ball), ("ball-rest", rest)):
        for name, change in changes.items():
            shutil.copytree(workspace / source, bad / name)
            change(bad / name)


def _edit(
    name: str, change: Callable[[list[list[str]]], list[list[str]]]
) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / name).read_text().splitlines()]
        (folder / name).write_text("\n".join(",".join(row) for row in change(rows)) + "\n")

    return edit


def _set(rows: list[list[str]], column: int, word: str) -> list[list[str]]:
    rows = [list(row) for row in rows]
    for row in rows:
        row[column] = word
    return rows


def _swapped(header: list[str]) -> list[str]:
    """Two columns of the rotation under each other's name: no rotation any more."""
    swap = {"r11": "r12", "r12": "r11"}
    return [swap.get(word, word) for word in header]


def _inches(row: list[str]) -> list[str]:
    return [row[0], *(repr(float(word) / 25.4) for word in row[1:4]), *row[4:]]


def _append(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)
