# SPDX-License-Identifier: Apache-2.0
"""What the demo of a head found, for programs: the layout of ``summary.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.inspection.results import Deviations, PointCounts, StepInspection
from armscan.pipeline.head_demo import HeadDemo
from armscan.pipeline.naming_truth import NamingErrors
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.reconstruction.result import PointFate
from armscan.report.hand_eye_numbers import total_covariance

FRACTION_RULE = (
    "rms and shares count every measured point of the feature (up to 1 mm from it), those that its "
    "fit left out included; points further away are counted beside them: they lie on what stands "
    "around, or are wrong"
)


def demo_data(
    demo: HeadDemo, *, head: str, seed: int, preset: str, seconds: Mapping[str, float]
) -> dict[str, Any]:
    """All figures; fractions are 0 to 1, lengths in mm, angles in degrees."""
    return {
        "kind": "demo",
        "simulated": True,
        "seed": seed,
        "preset": preset,
        "rule": FRACTION_RULE,
        "heads": {head: {**head_data(demo), "seconds": dict(seconds)}},
    }


def head_data(demo: HeadDemo) -> dict[str, Any]:
    """The figures of one head."""
    scanner = demo.instrument.scanner
    variance = np.diag(total_covariance(scanner))
    errors = demo.errors.hand_eye
    scans = [demo.scans[scene] for scene in ("plate", "ball", "part")]
    sheets = demo.instrument.sensor.sheets
    return {
        "camera": [{"rms_px": camera.rms_px} for camera in demo.instrument.cameras],
        "sheets": [{"name": sheet.name, "rms_mm": sheet.rms_mm} for sheet in sheets],
        "hand_eye": {
            "rotation_error_deg": errors.rotation_deg,
            "translation_error_mm": errors.translation_mm,
            "sigma_rotation_deg": float(np.degrees(np.sqrt(variance[:3].sum()))),
            "sigma_translation_mm": float(np.sqrt(variance[3:].sum())),
            "normalised_error": errors.normalised,
        },
        "plate": {
            **_counts(demo.plate.counts),
            **_shares(demo.plate.fitted, (0.03, 0.05, 0.08)),
            "std_mm": demo.plate.fitted.value("std_mm"),
            "reference": demo.plate.fitted.reference,
        },
        "sphere": {
            **_counts(demo.ball.counts),
            **_shares(demo.ball.nominal, (0.03, 0.05, 0.08)),
            "diameter_mm": demo.ball.diameter.value_mm,
            "diameter_error_mm": demo.ball.diameter.value_mm - demo.ball.nominal_diameter_mm,
            "diameter_sigma_mm": demo.ball.diameter.sigma_mm,
            "reference": demo.ball.nominal.reference,
        },
        "steps": [
            *(_step(step, "Base") for step in demo.steps),
            _step(demo.still_step, "Sensor"),
        ],
        "part": {
            "n_points": len(demo.part.distance_mm),
            "n_measured": len(demo.part.distance_mm) + demo.part.n_elsewhere,
            "n_beyond_1mm": demo.part.n_elsewhere,
            "rms_mm": demo.part.rms_mm,
            "fraction_within_0p05mm": demo.part.fraction_within(0.05),
            "normalised_rms": demo.part.normalised_rms,
        },
        "named_stripes_per_exposure": float(np.mean([stripes for stripes, _ in instants(scans)])),
        "points_per_exposure": float(np.mean([points for _, points in instants(scans)])),
        "naming": {scene: naming_data(found) for scene, found in demo.naming.items()},
    }


def instants(scans: Sequence[ScanReconstruction]) -> list[tuple[int, int]]:
    """Light sheets that gave a measured point, and measured points, of every instant.

    What two cameras saw at one instant counts once.
    """
    found: dict[tuple[int, int], tuple[set[int], int]] = {}
    for number, scan in enumerate(scans):
        for row, image in zip(scan.image_rows, scan.images, strict=True):
            key = (number, scan.exposures[row].row.t_ns)
            sheets, count = found.get(key, (set(), 0))
            measured = image.fate == int(PointFate.MEASURED)
            sheets = sheets | set(image.sheet[measured].tolist())
            found[key] = (sheets, count + int(measured.sum()))
    return [(len(sheets), count) for sheets, count in found.values()]


def naming_data(found: NamingErrors) -> dict[str, Any]:
    """Names against the truth: counts over the instants that were checked."""
    return {**asdict(found), "wrong_share": found.wrong_share, "named_share": found.named_share}


def fraction_within(values_mm: FloatArray, limit_mm: float) -> float:
    """Share of values whose size is at most a limit."""
    return float(np.mean(np.abs(values_mm) <= limit_mm))


def _shares(deviations: Deviations, limits_mm: Sequence[float]) -> dict[str, Any]:
    values = deviations.deviations_mm
    return {
        f"fraction_within_{limit:g}mm".replace(".", "p"): fraction_within(values, limit)
        for limit in limits_mm
    }


def _counts(counts: PointCounts) -> dict[str, int]:
    """Points of the feature, of the cloud, and those further from the feature than 1 mm."""
    return {
        "n_points": counts.n_feature,
        "n_measured": counts.n_region,
        "n_beyond_1mm": counts.n_region - counts.n_feature,
    }


def _step(step: StepInspection, frame: str) -> dict[str, Any]:
    return {
        "nominal_mm": step.nominal_height_mm,
        "mean_mm": float(step.heights_mm.mean()),
        "std_mm": float(step.heights_mm.std(ddof=1)),
        "fitted_mm": step.height.value_mm,
        "fitted_sigma_mm": step.height.sigma_mm,
        "n_points": step.counts.n_feature,
        "n_measured": step.counts.n_region,
        "frame": frame,
    }
