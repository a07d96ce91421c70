# SPDX-License-Identifier: Apache-2.0
"""What a twin says about itself, and writes down, is what its head is made of."""

from __future__ import annotations

import json

import numpy as np
import pytest

from armscan.devices.sources import TwinScene
from armscan.simulation.head import HEADS, RIGHT
from armscan.simulation.instrument import Instrument
from armscan.simulation.twin import InstrumentTruth, latency_ns


@pytest.mark.parametrize("name", HEADS)
def test_the_document_holds_all_cameras_sources_and_sheets(name: str) -> None:
    instrument = Instrument.build(name, "thesis", 5)
    head, truth = instrument.head, InstrumentTruth(instrument, "thesis", 5)
    document = json.loads(truth.document())
    assert document["simulated"] is True
    assert document["head"] == name
    sheets = [sheet for source in document["sources"].values() for sheet in source]
    assert sheets == [laser.name for laser in head.lasers]
    assert list(document["sheet_points_sensor_mm"]) == sheets
    for laser in head.lasers:
        points = np.array(document["sheet_points_sensor_mm"][laser.name])
        assert np.abs(laser.offset_mm(points)).max() < 1e-9
    assert document["camera_parameters"][:2] == [head.camera.fx, head.camera.fy]
    assert ("right_camera_parameters" in document) == (len(head.cameras) > 1)


def test_the_right_camera_is_told_and_missing_ones_are_not() -> None:
    instrument = Instrument.build("thesis-multi", "clean", 6)
    truth = InstrumentTruth(instrument, "clean", 6)
    mounted = instrument.head.cameras[RIGHT]
    document = json.loads(truth.document())
    assert truth.right_camera_parameters is not None and truth.right_from_sensor is not None
    lens = mounted.camera
    expected = [lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]
    assert truth.right_camera_parameters.tolist() == expected
    assert document["right_camera_parameters"] == expected
    pose = document["right_from_sensor"]
    point = np.array([3.0, -2.0, 141.0])
    by_document = np.array(pose["rotation"]) @ point + pose["translation_mm"]
    by_head = (
        mounted.camera_from_sensor.rotation @ point + mounted.camera_from_sensor.translation_mm
    )
    np.testing.assert_array_equal(by_document, by_head)
    # the right camera sees what the left one sees in its middle
    assert np.abs(lens.project(by_document) - [1536.0, 1024.0]).max() < 300.0
    single = InstrumentTruth(Instrument.build("thesis-single", "clean", 6), "clean", 6)
    assert single.right_camera_parameters is None and single.right_from_sensor is None


def test_only_the_scene_latency_has_one() -> None:
    truth = InstrumentTruth(Instrument.build("thesis-single", "thesis", 5), "thesis", 5)
    assert json.loads(truth.document("latency"))["latency_ns"] == latency_ns(5) != 0
    others: tuple[TwinScene | None, ...] = (None, "plate", "probing")
    for scene in others:
        assert "latency_ns" not in json.loads(truth.document(scene))
