# SPDX-License-Identifier: Apache-2.0
"""Errors of the whole chain on rendered photographs, over several seeds.

    python benchmarks/photo_chain.py 1 2 3 4 5

Each line is one seed: the demo is rendered, calibrated and measured, and compared with its truth.
``in sigmas`` is the length of the parameters' error in their own sigmas; a right covariance gives
about the square root of their count. Everything here is simulated.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from armscan.jobs.twin.demo import DemoRequest, run_photo_demo

COLUMNS = (
    "seed",
    "f error px",
    "sigma",
    "camera in sigmas",
    "sheet deg",
    "mm",
    "rms mm",
    "sheet in sigmas",
    "points",
    "median mm",
    "rms mm",
    "z rms",
    "within 2 sigma",
)


def row(seed: int) -> tuple[str, ...]:
    with tempfile.TemporaryDirectory() as folder:
        data: Any = run_photo_demo(DemoRequest(Path(folder), seed)).data
    errors = data["errors"]
    sheet = errors["sheet"]
    return (
        str(seed),
        f"{errors['focal_px']:+.3f}",
        f"{errors['focal_sigma_px']:.3f}",
        f"{errors['camera_normalised']:.2f} of {errors['n_camera_parameters']}",
        f"{sheet['angle_deg']:.4f}",
        f"{sheet['offset_mm']:+.4f}",
        f"{sheet['rms_mm']:.4f}",
        f"{sheet['normalised']:.2f} of {sheet['n_parameters']}",
        str(errors["n_on_object"]),
        f"{errors['points_median_mm']:.4f}",
        f"{errors['points_rms_mm']:.4f}",
        f"{errors['points_normalised_rms']:.2f}",
        f"{errors['points_within_2_sigma']:.3f}",
    )


if __name__ == "__main__":
    print(" | ".join(COLUMNS))
    for word in sys.argv[1:] or ("1", "2", "3"):
        print(" | ".join(row(int(word))), flush=True)
