# SPDX-License-Identifier: Apache-2.0
"""Pictures of the demo of a head: photographs, histograms, the part."""

from __future__ import annotations

from collections.abc import Mapping

from armscan.pipeline.head_demo import HeadDemo
from armscan.reconstruction.result import PointFate
from armscan.records.exposure import Exposure
from armscan.report import cloud_figures
from armscan.report import hand_eye_figures as hand_eye_charts
from armscan.report.deviation_figures import (
    deviation_histogram,
    deviation_view,
    height_histogram,
)
from armscan.report.drawing import Marks, photo_markup
from armscan.report.hand_eye_numbers import hand_eye_numbers, total_covariance
from armscan.report.page import Gallery, Picture
from armscan.report.stripe_figures import sheet_colour

SCENE_TEXTS = {
    "camera": "the circle grid, to calibrate the camera or cameras",
    "laser": "the laser on the grid (its points marked), to calibrate the light sheets",
    "hand-eye": "a posture over the flat plate, to calibrate the hand-eye",
    "plate": "the plate again, scanned by hand",
    "ball": "the ball",
    "steps": "gauge blocks",
    "still-step": "a gauge block, standing still",
    "part": "the free-form part",
    "waves": "a wavy plate",
}


def photographs_of(demo: HeadDemo, photographs: Mapping[str, Exposure]) -> Gallery:
    """One image a scene; stripes are marked on the bright target, and where they were named."""
    on_target = {image.source: image.profile for image in demo.instrument.laser.images}
    pictures = []
    for scene, exposure in photographs.items():
        marks: list[Marks] = []
        text = SCENE_TEXTS[scene]
        if scene == "laser" and exposure.source in on_target:
            points = on_target[exposure.source].points_px
            marks = [Marks(points, sheet_colour(0), "dot", 5.0)]
        elif demo.naming:
            marks = _named_marks(demo, scene, exposure.source)
            text += ", coloured by sheet" if marks else ""
        markup = photo_markup(exposure, marks, f"Rendered image: {text}", longest_px=900)
        pictures.append(Picture(markup, text, scene))
    return Gallery(tuple(pictures), 300)


def _named_marks(demo: HeadDemo, scene: str, source: str) -> list[Marks]:
    """The measured points of one exposure, a colour a sheet."""
    images = [image for name, scan in demo.scans.items() if name == scene for image in scan.images]
    for image in images:
        if image.profile.source == source:
            measured = image.fate == int(PointFate.MEASURED)
            return [
                Marks(image.profile.points_px[measured & (image.sheet == k)], sheet_colour(k))
                for k in sorted(set(image.sheet[measured].tolist()))
            ]
    return []


def hand_eye_pictures(demo: HeadDemo) -> tuple[Picture, ...]:
    """Residuals and left-out postures of the hand-eye."""
    scanner, fit = demo.instrument.scanner, demo.instrument.hand_eye.fit
    numbers = hand_eye_numbers(fit.calibration, total_covariance(scanner))
    return (
        hand_eye_charts.residuals_by_posture(fit),
        hand_eye_charts.left_out_bars(fit, numbers.rotation_sigma_deg, numbers.size_sigma_mm),
    )


def histograms(demo: HeadDemo) -> Gallery:
    """Plate, ball and blocks, as the thesis shows them."""
    still = demo.still_step
    pictures = [
        deviation_histogram(
            demo.plate.fitted, title="Plate (as figure 5.12)", axis_label="distance to plane, mm"
        ),
        deviation_histogram(
            demo.ball.nominal,
            title="Ball (as figure 5.14)",
            axis_label="distance to the centre minus the radius, mm",
        ),
        height_histogram(
            still.heights_mm,
            still.nominal_height_mm,
            still.height.value_mm,
            title=f"Step of {still.nominal_height_mm:g} mm, one exposure (as figure 5.19)",
        ),
    ]
    pictures += [
        height_histogram(
            step.heights_mm,
            step.nominal_height_mm,
            step.height.value_mm,
            title=f"Step of {step.nominal_height_mm:g} mm, through the arm",
        )
        for step in demo.steps
    ]
    return Gallery(tuple(pictures), 420)


def part_pictures(demo: HeadDemo) -> Gallery:
    """The part in space and its deviations."""
    cloud = demo.part.scan.cloud
    return Gallery(
        (
            cloud_figures.cloud_view(cloud),
            deviation_view(
                cloud.points_mm[demo.part.rows],
                demo.part.distance_mm,
                title="Deviation from the true surface",
                frame="Base",
                reference="the true surface, which only a simulator knows",
            ),
        ),
        460,
    )
