# SPDX-License-Identifier: Apache-2.0
"""Why no board was found in a placement is told as it was in its first image."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.calibration.sheets.board_points import HeadCameras
from armscan.geometry.estimate import FitFailure
from armscan.pipeline import targets
from armscan.pipeline.laser import find_placements
from armscan.records.exposure import Exposure
from armscan.vision.targets.target import Chessboard
from rigs.sheet_rig import thesis_rig


def test_the_first_images_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without laser it is looked for first; that reason was lost, being no true value."""
    monkeypatch.setattr(
        targets,
        "detect_target",
        lambda image, *_: FitFailure(f"nothing in {image.source}"),
    )
    rig = thesis_rig()
    image = np.zeros((64, 64), np.uint8)
    pair = Exposure(image, "on.png"), Exposure(image, "off.png")
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    (placement,) = find_placements([pair], Chessboard(8, 6, 5.0), cameras)
    assert placement.seen == {0: FitFailure("nothing in off.png")}
    assert placement.placed is None
