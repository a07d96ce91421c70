# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the command tests: the drawn bench, and a command that must fail well."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from armscan.cli import main
from rigs.drawn_bench import CAMERA_TILTS, LASER_PLACES, OBJECT_PLACE, TARGET, Bench, draw


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Draw the images once."""
    folder = tmp_path_factory.mktemp("bench")
    for name in ("camera", "on", "off", "object"):
        (folder / name).mkdir()
    for k, (a, b) in enumerate(CAMERA_TILTS):
        image = draw(a, b, 150.0 + 4 * k, has_laser=False)
        cv2.imwrite(str(folder / "camera" / f"view{k}.png"), image)
    for k, (a, b, z) in enumerate(LASER_PLACES):
        for name, has_laser in (("on", True), ("off", False)):
            cv2.imwrite(str(folder / name / f"place{k}.png"), draw(a, b, z, has_laser=has_laser))
    for name, has_laser in (("laser", True), ("dark", False)):
        image = draw(*OBJECT_PLACE, has_laser=has_laser, is_plain=True)
        cv2.imwrite(str(folder / "object" / f"{name}.png"), image)
    return Bench(folder)


@pytest.fixture(scope="session")
def calibrated(bench: Bench) -> Bench:
    """The bench with ``camera.json`` and ``sensor.json`` written by the commands."""
    words = ["calibrate", "camera", bench.camera_images, "--target", TARGET]
    assert main([*words, "-o", str(bench.camera), "--distortion", "none"]) == 0
    words = ["calibrate", "laser", "--camera", str(bench.camera), "--on", bench.on]
    words += ["--off", bench.off, "--target", TARGET, "-o", str(bench.sensor)]
    assert main(words) == 0
    return bench


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail with exit code 2 and one sentence; return the sentence.

    It may leave the page of a refusal, and nothing else.
    """

    def run(*words: object, writes: Path | None = None) -> str:
        before = _listing(writes)
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert code == 2, err
        assert out == ""
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert "Traceback" not in err
        assert _listing(writes) == before
        return err

    return run


def _listing(folder: Path | None) -> dict[str, bytes]:
    if folder is None or not folder.is_dir():
        return {}
    return {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if path.is_file() and not path.name.endswith(".refused.html")
    }
