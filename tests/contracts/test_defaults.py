# SPDX-License-Identifier: Apache-2.0
"""A command without options does what the library does without options.

Help texts show a default, so the command line repeats it; here the two are held together.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.hand_eye.observations import HandEyeOptions
from armscan.calibration.hand_eye.probed_plate import ProbingOptions
from armscan.calibration.sheets.result import SheetOptions
from armscan.cli.app import command
from armscan.inspection.selection import InspectionOptions, StepOptions
from armscan.jobs.demo import DemoRequest
from armscan.jobs.hand_eye import HandEyeRequest
from armscan.markers.alignments import MarkerMatchOptions
from armscan.markers.candidates import RingMatchOptions
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.register import RegisterOptions
from armscan.pipeline.simulate import SimulateOptions
from armscan.pipeline.verify import VerifyOptions
from armscan.reconstruction.label_single import DepthRange
from armscan.reconstruction.label_stereo import StereoLabelOptions
from armscan.storage.images import ImageOptions
from armscan.vision.rings import RingOptions
from armscan.vision.stripe.image import StripeOptions


def default_of(request: type[Any], name: str) -> Any:
    """Default of one field of a request."""
    return {field.name: field.default for field in fields(request)}[name]


STRIPES = {
    "stripe_method": StripeOptions().method,
    "laser_colour": StripeOptions().laser_colour,
}
IMAGES = {"bits_used": ImageOptions().bits_used, "bits_align": ImageOptions().align}
FEATURE = {"feature_mm": InspectionOptions().feature_mm}
EXPECTED: dict[tuple[str, ...], dict[str, Any]] = {
    ("calibrate", "camera"): {
        "distortion": CameraOptions().distortion,
        "auto_leave_out": CameraOptions().leave_out_misfits,
        "board_warp": CameraOptions().solve_warp,
        **IMAGES,
    },
    ("calibrate", "laser"): {
        "sheets": SheetOptions().n_sheets,
        "margin_mm": SheetOptions().margin_mm,
        **STRIPES,
        **IMAGES,
    },
    ("simulate",): {
        "preset": SimulateOptions().preset,
        "seed": SimulateOptions().seed,
        "processes": SimulateOptions().processes,
    },
    ("register",): {
        "sigma_mm": RegisterOptions().sigma_mm,
        "least_common": MarkerMatchOptions().least_common,
        "by_id": RegisterOptions().is_by_id,
    },
    ("probe",): {
        "side": ProbingOptions().side,
        "feature": ProbingOptions().feature,
        "leave_out": ProbingOptions().leave_out_outliers,
    },
    ("inspect", "plane"): FEATURE,
    ("inspect", "sphere"): FEATURE,
    ("inspect", "step"): {**FEATURE, "margin": StepOptions().margin_mm},
    ("markers",): {
        "diameter": RingMatchOptions().diameter_mm,
        "min_perimeter": RingOptions().min_perimeter_px,
        "max_perimeter": RingOptions().max_perimeter_px,
        "max_roundness": RingOptions().max_roundness,
        "disc": RingOptions().disc,
        **IMAGES,
    },
    ("verify",): {
        **FEATURE,
        "mpe": VerifyOptions().mpe_mm,
        "uncertainty": VerifyOptions().reference_u_mm,
    },
    ("calibrate", "hand-eye"): {
        "arm_position_mm": HandEyeOptions().arm_position_mm,
        "arm_rotation_deg": HandEyeOptions().arm_rotation_rad,
        "plate_flatness_mm": HandEyeOptions().plate_flatness_mm,
        "solve_plate": HandEyeOptions().solve_plate,
        "euler": default_of(HandEyeRequest, "euler"),
        "side": default_of(HandEyeRequest, "side"),
        **STRIPES,
    },
    ("demo",): {
        "seed": default_of(DemoRequest, "seed"),
        "preset": default_of(DemoRequest, "preset"),
    },
    ("reconstruct",): {"sheet": MeasureOptions().sheet, **STRIPES, **IMAGES},
}


def parameters(path: tuple[str, ...]) -> dict[str, Any]:
    node: Any = command()
    for word in path:
        node = node.commands[word]
    return {parameter.name: parameter for parameter in node.params}


@pytest.mark.parametrize("path", EXPECTED, ids=" ".join)
def test_defaults_of_a_command_are_those_of_its_options(path: tuple[str, ...]) -> None:
    found = parameters(path)
    assert {name: found[name].default for name in EXPECTED[path]} == EXPECTED[path]


def test_the_depth_margin_that_texts_name_is_the_default() -> None:
    text = f"{DepthRange().margin:g}"
    option = parameters(("reconstruct",))["depth_margin"]
    assert option.default is None
    stereo = f"{StereoLabelOptions().depths.margin:g}"
    assert f"Without it {text}; with two cameras {stereo};" in option.help
    page = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"
    words = " ".join(page.read_text().split())
    assert f"up to X times its width at either end ({text} unless said)" in words
