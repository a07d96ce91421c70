# SPDX-License-Identifier: Apache-2.0
"""Names of the multi-line head's stripes in rendered images of the twin.

Command: ``python benchmarks/multi_rendered.py [preset] [seed] [scene ...]``
(default thesis, 1, steps). One exposure of each scene, the middle one of the recording.

The sensor is the true one (sheets fitted to their true points), with the covariance of the rig of
the feature-level tests. A point's true sheet is that of the nearest true stripe, within 1.5 px.
Shared points have a partner of the other camera within 0.1 mm in space. Then, for the sheet with
the bright centre and for the others: the share of the true points without an accepted point.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from armscan.devices.sources import load_driver
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.calibration import (
    CameraCalibration,
    SecondCamera,
    SensorCalibration,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.label_stereo import StereoLabeller
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from rigs.plain_scanner import stored_sheet
from rigs.sheet_rig import PROVENANCE
from rigs.stereo_head import DEPTHS_MM, StereoHead

SAME_PX = 1.5
SAME_MM = 0.1
BRIGHT = "A.6"


def fitted(points: FloatArray) -> LightSheet:
    points = points[(points[:, 2] > 90.0) & (points[:, 2] < 190.0)]
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    depth = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    depth /= np.linalg.norm(depth)
    along = np.cross(depth, normal)
    axes = np.stack([along, np.cross(normal, along), normal])
    sheet = LightSheet(origin_mm=centre, axes=axes, scale_mm=30.0, bow_mm=np.zeros(5))
    for _ in range(4):
        height, _, by_parameters = sheet.height_with_jacobian(points)
        sheet = sheet.updated(np.linalg.lstsq(by_parameters, -height, rcond=None)[0])
    return sheet


def true_sensor(truth: Any) -> SensorCalibration:
    covariance = StereoHead.thesis().covariance
    box = np.array([0.0, 0.0, 3071.0, 2047.0])

    def camera(parameters: FloatArray) -> CameraCalibration:
        model = CameraModel.from_parameters(parameters, 3072, 2048)
        return CameraCalibration(
            camera=model,
            covariance=np.zeros((9, 9)),
            has_covariance=True,
            rms_px=0.07,
            sigma_point_px=0.05,
            n_views=14,
            n_points=999,
            covered_px=box,
            provenance=PROVENANCE,
        )

    names = sorted(truth.sheet_points_mm, key=lambda name: int(name.split(".")[1]))
    sheets = tuple(
        stored_sheet(
            name,
            fitted(truth.sheet_points_mm[name]),
            DEPTHS_MM,
            rms_mm=0.004,
            n_boards=12,
            n_points=6000,
        )
        for name in names
    )
    second = SecondCamera(
        camera=camera(truth.right_camera_parameters), right_from_sensor=truth.right_from_sensor
    )
    return SensorCalibration(
        camera=camera(truth.camera_parameters),
        sheets=sheets,
        covariance=covariance,
        provenance=PROVENANCE,
        diagnostics=None,
        second=second,
    )


def true_sheets(
    stripes: Any, names: list[str], profile: Profile
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    pixels = np.concatenate([s.points_px for s in stripes])
    places = np.concatenate([s.points_base_mm for s in stripes])
    sheet = np.concatenate([np.full(len(s.points_px), names.index(s.sheet)) for s in stripes])
    distance, nearest = cKDTree(pixels).query(profile.points_px)
    return np.where(distance < SAME_PX, sheet[nearest], -1), places[nearest], pixels, sheet


def lost(pixels: FloatArray, profile: Profile) -> float:
    seen = cKDTree(profile.points_px[profile.is_accepted])
    return float((seen.query(pixels)[0] > SAME_PX).mean()) if len(pixels) else float("nan")


def main() -> None:
    preset = sys.argv[1] if len(sys.argv) > 1 else "thesis"
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    twin = load_driver("twin")(head="thesis-multi", preset=preset, seed=seed)
    sensor = true_sensor(twin.truth)
    names = [sheet.name for sheet in sensor.sheets]
    print(f"preset {preset}, seed {seed}")
    for scene in sys.argv[3:] or ["steps"]:
        scan = twin.scan(scene)
        rows = [i for i, row in enumerate(scan.rows) if row.camera == 0]
        left = rows[len(rows) // 2]
        t_ns = scan.rows[left].t_ns
        right = next(i for i, row in enumerate(scan.rows) if row.camera == 1 and row.t_ns == t_ns)
        profiles = [extract_stripes(scan.exposure(i)) for i in (left, right)]
        found = StereoLabeller(sensor).label(profiles).profiles
        truths = [
            true_sheets(scan.true_stripes(i), names, profile)
            for i, profile in zip((left, right), profiles, strict=True)
        ]
        ok = profiles[0].is_accepted & (truths[0][0] >= 0)
        there = truths[1][1][(truths[1][0] >= 0) & profiles[1].is_accepted]
        shared = ok & (cKDTree(there).query(truths[0][1])[0] < SAME_MM)
        wrong = sum(
            int(((named.sheet >= 0) & (named.sheet != truth[0])).sum())
            for named, truth in zip(found, truths, strict=True)
        )
        share = (found[0].sheet == truths[0][0])[shared].mean()
        stray = int((profiles[0].is_accepted & (truths[0][0] < 0)).sum())
        print(
            f"{scene}: {len(profiles[0])} left points, shared {int(shared.sum())}, named "
            f"{share:.2%}, wrong in both pictures {wrong}, stray points accepted by the "
            f"extraction {stray}"
        )
        for name, profile, truth in zip(("left", "right"), profiles, truths, strict=True):
            bright = truth[3] == names.index(BRIGHT)
            print(
                f"  {name}: lost of {BRIGHT} {lost(truth[2][bright], profile):.1%}, of the others "
                f"{lost(truth[2][~bright], profile):.1%}"
            )


if __name__ == "__main__":
    main()
