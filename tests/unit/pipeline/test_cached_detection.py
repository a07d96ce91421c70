# SPDX-License-Identifier: Apache-2.0
"""What was found in an image is taken from the cache, and only what belongs to that image."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import armscan
from armscan.geometry.estimate import FitFailure
from armscan.pipeline import measure, targets
from armscan.pipeline.measure import cached_profile
from armscan.pipeline.targets import cached_target
from armscan.records.exposure import Exposure, SensorWindow
from armscan.storage import detection_cache
from armscan.storage.detection_cache import SUFFIX, DetectionCache, detection_key, end_writing
from armscan.vision.stripe.image import StripeOptions
from armscan.vision.targets.target import Chessboard, CircleGrid, Target, TargetView

GRID = CircleGrid(5, 4, 10.0)
BOARD = Chessboard(5, 4, 10.0)


def circles() -> Exposure:
    image = np.full((240, 320), 200, np.uint8)
    for row in range(GRID.rows):
        for column in range(GRID.columns):
            cv2.circle(image, (60 + 48 * column, 40 + 50 * row), 14, 40, -1, cv2.LINE_AA)
    return Exposure(cv2.GaussianBlur(image, (0, 0), 1.0), "grid.png")


def chessboard() -> Exposure:
    j, i = np.mgrid[:240, :320]
    is_dark = ((i // 40 + j // 40) % 2 == 0) & (i >= 40) & (i < 280) & (j >= 40) & (j < 240)
    image = np.where(is_dark, 40, 200).astype(np.uint8)
    return Exposure(cv2.GaussianBlur(image, (0, 0), 1.0), "board.png")


def stripe() -> Exposure:
    rows, columns = np.mgrid[:200, :300]
    light = 20.0 + 180.0 * np.exp(-0.5 * ((columns - 150.0 - 0.1 * rows) / 2.0) ** 2)
    noise = np.random.default_rng(1).normal(size=light.shape)
    return Exposure(np.clip(light + noise, 0, 255).astype(np.uint8), "stripe.png")


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    for item in fields(a):
        left, right = getattr(a, item.name), getattr(b, item.name)
        if isinstance(left, np.ndarray):
            np.testing.assert_array_equal(left, right)
            assert left.dtype == right.dtype
        elif is_dataclass(left):
            assert_same(left, right)
        else:
            assert left == right


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the images that were looked at."""
    names: list[str] = []
    for module, function in ((targets, "detect_target"), (measure, "extract_stripes")):
        real = getattr(module, function)

        def spy(exposure: Exposure, *rest: Any, real: Any = real) -> Any:
            names.append(exposure.source)
            return real(exposure, *rest)

        monkeypatch.setattr(module, function, spy)
    return names


@pytest.mark.parametrize(
    ("exposure", "target"),
    [(circles(), GRID), (chessboard(), BOARD), (chessboard(), GRID)],
    ids=["circles with edges", "chessboard", "not found"],
)
def test_the_second_look_gives_the_same_without_looking(
    exposure: Exposure, target: Target, tmp_path: Path, looked: list[str]
) -> None:
    cache = DetectionCache(tmp_path / "cache")
    first = cached_target(exposure, target, cache)
    assert isinstance(first, FitFailure) == (target is GRID and exposure.source == "board.png")
    assert_same(cached_target(exposure, target, cache), first)
    assert looked == [exposure.source]


def test_stripes_are_kept_with_their_background(tmp_path: Path, looked: list[str]) -> None:
    cache = DetectionCache(tmp_path / "cache")
    lit = stripe()
    dark = replace(lit, image=np.full_like(lit.image, 20), source="dark.png")
    first = cached_profile(lit, None, None, cache)
    assert len(first) > 100
    assert_same(cached_profile(lit, None, None, cache), first)
    assert len(looked) == 1
    cached_profile(lit, None, dark, cache)
    cached_profile(lit, StripeOptions(smoothing_px=0.0), None, cache)
    assert len(looked) == 3


def other_pixel(exposure: Exposure) -> Exposure:
    image = exposure.image.copy()
    image[3, 5] ^= 1
    return replace(exposure, image=image)


@pytest.mark.parametrize(
    "change",
    [
        other_pixel,
        lambda e: replace(e, image=np.stack([e.image] * 3, axis=-1)),
        lambda e: replace(e, image=e.image.astype(np.uint16)),
        lambda e: replace(e, bits_used=7, image=e.image // 2),
        lambda e: replace(e, window=SensorWindow(8, 0)),
        lambda e: replace(e, source="other.png"),
    ],
)
def test_another_image_is_another_entry(change: Any) -> None:
    same = replace(circles(), t_ns=7, view="v", trigger_id=1)
    key = detection_key("target", circles(), (GRID,))
    assert detection_key("target", same, (GRID,)) == key
    assert detection_key("target", change(circles()), (GRID,)) != key


def test_other_options_and_other_code_are_other_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    exposure = circles()
    keys = {
        detection_key("target", exposure, (GRID,)),
        detection_key("stripes", exposure, (GRID,)),
        detection_key("target", exposure, (replace(GRID, pitch_mm=10.5),)),
        detection_key("target", exposure, (GRID,), exposure),
    }
    monkeypatch.setattr(detection_cache, "code_version", lambda: "newer")
    keys.add(detection_key("target", exposure, (GRID,)))
    assert len(keys) == 5


def test_the_code_version_follows_the_detectors_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy of the package with one line more in a detector has another version."""
    root = tmp_path / "armscan"
    for package in detection_cache.CODE:
        source = Path(armscan.__file__).parent / package
        for path in source.rglob("*.py"):
            copy = root / package / path.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    version = detection_cache.code_version.__wrapped__
    here = version()
    monkeypatch.setattr(armscan, "__file__", str(root / "__init__.py"))
    assert version() == here
    saddle = root / "vision" / "targets" / "saddle.py"
    saddle.write_text(saddle.read_text("utf-8") + "\n", "utf-8")
    assert version() != here


@pytest.mark.parametrize("damage", ["cut", "flipped", "renamed", "empty", "foreign"])
def test_a_damaged_entry_is_looked_for_again(
    damage: str, tmp_path: Path, looked: list[str]
) -> None:
    cache = DetectionCache(tmp_path)
    first = cached_target(circles(), GRID, cache)
    (entry,) = tmp_path.glob(f"*{SUFFIX}")
    content = bytearray(entry.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 4
    elif damage == "renamed":
        # whole, but of another image
        cached_target(chessboard(), BOARD, cache)
        (other,) = set(tmp_path.glob(f"*{SUFFIX}")) - {entry}
        content = bytearray(other.read_bytes())
        looked.clear()
        looked.append("grid.png")
    entry.write_bytes(
        {"cut": content[:-9], "empty": b"", "foreign": b"x" * 99}.get(damage, content)
    )
    again = cached_target(circles(), GRID, cache)
    assert_same(again, first)
    assert looked == ["grid.png", "grid.png"]
    assert_same(cached_target(circles(), GRID, cache), first)
    assert len(looked) == 2


def test_a_folder_that_may_not_be_written_costs_time_only(
    tmp_path: Path, looked: list[str]
) -> None:
    (tmp_path / "cache").write_text("a file")
    cache = DetectionCache(tmp_path / "cache")
    assert isinstance(cached_target(circles(), GRID, cache), TargetView)
    assert isinstance(cached_target(circles(), GRID, cache), TargetView)
    assert len(looked) == 2
    cache.trim()
    assert (tmp_path / "cache").read_text() == "a file"


def test_what_an_earlier_run_found_is_counted_apart(tmp_path: Path) -> None:
    """A run that asks twice for what it found itself has saved no time."""
    first = DetectionCache(tmp_path)
    first.put("a", FitFailure("none"))
    assert first.get("a") is not None
    assert first.n_earlier == 0
    second = DetectionCache(tmp_path)
    second.put("b", FitFailure("none"))
    assert all(second.get(name) is not None for name in ("a", "a", "b"))
    assert second.get("c") is None
    assert second.n_earlier == 1


def test_the_folder_stays_below_its_limit(tmp_path: Path) -> None:
    """What was used last stays; other files are left alone."""
    cache = DetectionCache(tmp_path)
    found = FitFailure("x" * 1000)
    for k, name in enumerate("abcd"):
        cache.put(name, found)
        os.utime(tmp_path / f"{name}{SUFFIX}", (k, k))
    size = (tmp_path / f"a{SUFFIX}").stat().st_size
    assert cache.get("a") == found
    (tmp_path / "mine.txt").write_text("y" * 5000)
    cache.trim(2 * size)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {f"a{SUFFIX}", f"d{SUFFIX}", "mine.txt"}


def test_no_cache_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cached_target(circles(), GRID)
    cached_profile(stripe())
    assert list(tmp_path.iterdir()) == []


def test_an_entry_that_is_written_while_the_program_ends_is_whole_and_none_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C waits for no thread, and would cut what one is writing."""
    monkeypatch.setattr(detection_cache, "_WRITING", threading.Lock())
    under_way, moved = threading.Event(), Path.replace

    def move_slowly(self: Path, target: Path) -> Path:
        under_way.set()
        time.sleep(0.3)
        return moved(self, target)

    monkeypatch.setattr(Path, "replace", move_slowly)
    cache, nothing = DetectionCache(tmp_path / "cache"), FitFailure("none", "look")
    first = threading.Thread(target=cache.put, args=("first", nothing))
    first.start()
    assert under_way.wait(10.0)
    end_writing()
    threading.Thread(target=cache.put, args=("second", nothing), daemon=True).start()
    time.sleep(0.1)
    assert {one.name for one in cache.folder.iterdir()} == {"CACHEDIR.TAG", f"first{SUFFIX}"}
    first.join()
