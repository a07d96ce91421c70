# SPDX-License-Identifier: Apache-2.0
"""A scan of a head with two cameras of which rows can be lost, without any rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armscan.geometry.poses import Pose
from armscan.models.calibration import ScannerCalibration
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.pipeline.instants import ExposurePair
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow, Session
from armscan.vision.stripe.image import StripeOptions
from rigs.plain_scanner import stored_hand_eye
from rigs.scan_fake import TOOL_FROM_SENSOR
from rigs.sheet_rig import PROVENANCE
from rigs.stereo_head import LEFT, RIGHT, RIGHT_FROM_LEFT, StereoHead, fitted_sheet, sheet_lasers
from rigs.stereo_scenes import Noise, draw_surfaces, expose

PERIOD_NS = 10_000_000
N_SHEETS = 3
SIGMA = 1e-5
"""Of every parameter of the calibration; too small to matter."""
WIDTH_PX, HEIGHT_PX = 8, 6


def small_head() -> StereoHead:
    """Three sheets, all but perfectly known."""
    lasers = sheet_lasers(N_SHEETS)
    covariance = SIGMA**2 * np.eye(9 + 8 * N_SHEETS + 15)
    views = TwoViews(LEFT, RIGHT, RIGHT_FROM_LEFT)
    return StereoHead(views, lasers, tuple(fitted_sheet(laser) for laser in lasers), covariance)


def plate_profiles(head: StereoHead) -> tuple[Profile, Profile]:
    """What both cameras see of a plate."""
    rng = np.random.default_rng(1)
    left, right = expose(head, draw_surfaces("plate", rng), Noise(), rng)
    return left.profile, right.profile


def stereo_scanner(head: StereoHead) -> ScannerCalibration:
    """The head on an arm."""
    hand_eye = stored_hand_eye(TOOL_FROM_SENSOR)
    return ScannerCalibration(sensor=head.calibration(), hand_eye=hand_eye, provenance=PROVENANCE)


@dataclass(frozen=True)
class TwoCameraScan:
    """Rows of both cameras, the arm moving evenly; the images are empty."""

    rows: tuple[ExposureRow, ...]
    arm: ArmTrack | None
    session: Session = field(
        default_factory=lambda: Session(
            cameras=(CameraSetup(width_px=WIDTH_PX, height_px=HEIGHT_PX),) * 2
        )
    )
    name: str = "two cameras"
    is_simulated: bool = False

    def exposure(self, row: int) -> Exposure:
        """An empty image."""
        of = self.rows[row]
        image = np.full((HEIGHT_PX, WIDTH_PX), 10, np.uint8)
        return Exposure(image, of.source, lasers=of.lasers, t_ns=of.t_ns, camera=of.camera)


def two_camera_scan(
    n: int = 3, *, lost: Sequence[tuple[int, int]] = (), late_ns: int = 0
) -> TwoCameraScan:
    """``n`` instants without trigger ids, less the (instant, camera) that were lost.

    The right camera's times are ``late_ns`` after the left one's.
    """
    times = PERIOD_NS * np.arange(1, n + 2)
    poses: list[Pose] = [Pose.from_vectors([2.9, 0.0, 0.0], [float(k), 0, 0]) for k in range(n + 1)]
    arm = ArmTrack(
        t_ns=times,
        rotations=np.array([pose.rotation for pose in poses]),
        translations_mm=np.array([pose.translation_mm for pose in poses]),
        is_known=np.ones(n + 1, dtype=bool),
    )
    taken = [(k, camera) for k in range(n) for camera in (0, 1) if (k, camera) not in lost]
    rows = tuple(
        ExposureRow(
            index=index,
            t_ns=int(times[k]) + PERIOD_NS // 2 + camera * late_ns,
            camera=camera,
            source=f"images/{k}{'lr'[camera]}.png",
            lasers=("A",),
        )
        for index, (k, camera) in enumerate(taken)
    )
    return TwoCameraScan(rows, arm)


@dataclass(frozen=True)
class SeenAs:
    """Takes the place of the stripe extraction: every image of a camera shows its profile."""

    profiles: tuple[Profile, Profile]

    def __call__(
        self, pair: ExposurePair, camera: CameraModel, options: StripeOptions, cache: None = None
    ) -> Profile:
        """The camera's profile under the image's name."""
        exposure = pair[0]
        return replace(self.profiles[exposure.camera], source=exposure.source)
