# SPDX-License-Identifier: Apache-2.0
"""What the command makes of a sensor that moves far, of one without covariance, of vain inputs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.jobs import hand_eye
from armscan.jobs.hand_eye import (
    STRAIGHT,
    Artefact,
    HandEyeInputs,
    StripeSource,
    read_hand_eye_inputs,
    solved_where_it_moves,
)
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.hand_eye import ObservedStripes
from armscan.pipeline.progress import silent
from armscan.reconstruction.labels import LabelledProfile
from armscan.storage.documents import read_sensor_calibration, sensor_document
from armscan.vision.stripe.image import StripeOptions
from rigs.calibration_documents import sensor_calibration
from rigs.hand_eye_fake import fake_fit

INPUTS = Path(__file__).parents[2] / "net" / "inputs"
TABLES = INPUTS / "tables"
REFUSED = FitFailure("the arm would have to scatter by 0.4 mm", "check the sensor")


def moved_far(bends: list[float], monkeypatch: pytest.MonkeyPatch) -> tuple[HandEyeFit, Any]:
    """A solution that moves its sensor, and the inputs of a plate whose points bend by so much.

    One entry of ``bends`` a solution, over the points' noise.
    """
    sensor, (fit, stripes) = sensor_calibration(), fake_fit()
    n = len(sensor.parameter_names)
    fit = replace(fit, sensor_step=np.zeros(n), sensor_covariance=sensor.covariance)
    left = iter(bends)

    def measured(
        stripes: Sequence[PosedStripe],
        images: Sequence[LabelledProfile],
        moved: SensorCalibration,
        sensor_step: FloatArray,
    ) -> tuple[tuple[PosedStripe, ...], float]:
        return tuple(stripes), next(left)

    monkeypatch.setattr(hand_eye, "measured_beside", measured)
    groups = (("scan", ObservedStripes(stripes, (), (), ())),)
    return fit, HandEyeInputs(groups, sensor, None, (), ())


def test_a_refusal_beside_the_moved_sensor_is_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first solution rests on derivatives that do not hold: it is not written in its place."""
    fit, inputs = moved_far([10.0 * STRAIGHT], monkeypatch)
    answers: list[HandEyeFit | FitFailure] = [fit, REFUSED]
    rounds = iter(answers)
    found, _ = solved_where_it_moves(lambda _: next(rounds), inputs)
    assert isinstance(found, FitFailure)
    assert REFUSED.reason in found.reason and "where the stripes move it" in found.reason
    assert found.remedy == REFUSED.remedy


def test_a_sensor_that_does_not_come_to_rest_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By how much the points of the solution that is written lie beside its derivatives."""
    bends = [0.5, 0.4, 0.3, 0.21]
    fit, inputs = moved_far(bends, monkeypatch)
    found, _ = solved_where_it_moves(lambda _: fit, inputs)
    assert isinstance(found, HandEyeFit)
    (warning,) = set(found.warnings) - set(fit.warnings)
    assert "4 solutions do not settle" in warning and "0.210 of their noise" in warning
    fit, inputs = moved_far([0.5, 0.4, 0.3, 0.9 * STRAIGHT], monkeypatch)
    found, _ = solved_where_it_moves(lambda _: fit, inputs)
    assert isinstance(found, HandEyeFit) and found.warnings == fit.warnings


@pytest.mark.parametrize("has_covariance", [True, False])
def test_sigmas_without_the_cameras_part_are_told_once(
    *, has_covariance: bool, tmp_path: Path
) -> None:
    """However many recordings there are."""
    sensor = read_sensor_calibration(INPUTS / "documents" / "sensor.json")
    camera = replace(sensor.camera, has_covariance=has_covariance)
    (tmp_path / "sensor.json").write_bytes(sensor_document(replace(sensor, camera=camera)))
    scans = (INPUTS / "plate-scan", tmp_path / "again")
    shutil.copytree(*scans)
    inputs = read_hand_eye_inputs(
        StripeSource(scans, tmp_path / "sensor.json"),
        Artefact(TABLES / "plate.csv"),
        StripeOptions(),
        silent,
    )
    told = [warning for warning in inputs.warnings if "came without covariance" in warning]
    assert told == [
        "the camera came without covariance: the hand-eye's sigmas leave its errors out"
    ] * (not has_covariance)


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ({"profiles": ("p*.yml",), "poses": Path("t.rob"), "sensor": Path("s.json")}, "--sensor"),
        ({"profiles": ("p*.yml",), "poses": Path("t.rob"), "arm": Path("arm.toml")}, "--arm"),
        (
            {"scans": (Path("scan"),), "sensor": Path("s.json"), "euler": "intrinsic-zyx"},
            "--euler",
        ),
    ],
)
def test_what_would_not_be_opened_is_refused(source: dict[str, Any], named: str) -> None:
    """Nor may an option that has no effect seem to have had one."""
    with pytest.raises(OptionError, match="without effect") as refused:
        StripeSource(**source)
    assert named in str(refused.value)
