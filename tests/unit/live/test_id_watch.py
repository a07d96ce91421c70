# SPDX-License-Identifier: Apache-2.0
"""What will not be matched, and what an arm says against its poses, is told while it arrives."""

from __future__ import annotations

import time
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armscan.devices.matching import MatchedInstant
from armscan.devices.protocols import ArmFlag, ArmSample, Frame
from armscan.pipeline.instants import SAME_TIME_NS
from armscan.pipeline.live.acquire import (
    EXPOSED_APART,
    FRAMES_WITHOUT,
    IDS_APART,
    LASERS_MIXED,
    LASERS_UNTOLD,
    SAMPLES_WITHOUT,
    TIMES_APART,
    WATCHED_NS,
    IdWatch,
    LiveEvent,
)
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.live.session import LiveSession
from armscan.reconstruction.sync import PoseStatus
from unit.live.test_session import ALL, Device, waited

IMAGE = np.zeros((1, 1), np.uint8)
STEP_NS = 500_000_000


def frame(k: int, trigger_id: int | None) -> Frame:
    return Frame(IMAGE, k, STEP_NS * k, STEP_NS * k, trigger_id=trigger_id)


def sample(k: int, trigger_id: int | None) -> ArmSample:
    return ArmSample(k, STEP_NS * k, STEP_NS * k, trigger_id=trigger_id)


def test_a_camera_without_ids_is_told_of_where_ids_decide() -> None:
    watch = IdWatch(is_triggered=True, has_controller=False)
    told = [watch.see_frame(frame(k, None), 0) for k in range(7)]
    n_quiet = WATCHED_NS // STEP_NS + 1
    assert told == [""] * n_quiet + [FRAMES_WITHOUT] * (7 - n_quiet)
    # the other camera may bear them
    assert watch.see_frame(frame(9, 4), 1) == ""
    assert watch.see_frame(frame(10, None), 0) == FRAMES_WITHOUT
    free = IdWatch(is_triggered=False, has_controller=False)
    assert not any(free.see_frame(frame(k, None), 0) for k in range(20))


def test_frames_before_the_first_trigger_are_no_news() -> None:
    watch = IdWatch(is_triggered=True, has_controller=False)
    assert not any(watch.see_frame(frame(k, None if k < 3 else k), 0) for k in range(20))


def test_an_arm_without_ids_is_told_of_once_images_bear_some() -> None:
    watch = IdWatch(is_triggered=True, has_controller=False)
    assert not any(watch.see_samples([sample(k, None)]) for k in range(20))
    watch.see_frame(frame(20, 1), 0)
    assert watch.see_samples([sample(21, None)]) == ""
    assert watch.see_samples([sample(25, None)]) == SAMPLES_WITHOUT
    # an arm that begins to bear ids has two seconds to meet an image
    assert watch.see_samples([sample(26, None), sample(26, 7)]) == ""
    assert watch.see_samples([sample(31, 12)]) == IDS_APART
    # of one id, and of triggers ten seconds apart
    other = MatchedInstant((frame(20, 1),), None, (), 1, None, PoseStatus.UNKNOWN_TRIGGER)
    watch.see_pair(other)
    assert watch.see_samples([sample(40, 1)]) == IDS_APART
    watch.see_pair(replace(other, status=PoseStatus.UNKNOWN_SAMPLE))
    assert watch.see_samples([sample(41, 8)]) == ""


def test_a_watch_that_runs_for_days_does_not_grow() -> None:
    watch = IdWatch(is_triggered=True, has_controller=True)
    tracemalloc.start()
    for k in range(5_000):
        watch.see_frame(frame(k, k), 0)
        watch.see_samples([sample(k, k + 10**6)])
    n_bytes = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert n_bytes < 20_000


def test_lasers_that_are_never_known_are_told_of() -> None:
    watch = IdWatch(is_triggered=False, has_controller=True)

    def see(k: int, **changes: Any) -> str:
        one = MatchedInstant((frame(k, None),), STEP_NS * k, None, None, None, PoseStatus.GAP)
        return watch.see_instant(replace(one, **changes))

    # no time is known yet
    assert not any(see(k, t_ns=None) for k in range(20))
    mixed = {"are_lasers_mixed": True}
    assert [see(k, **mixed) for k in range(20, 26)] == [""] * 5 + [LASERS_MIXED]
    assert see(26, lasers=("A",)) == "" and see(27) == ""
    # a controller that is silent, or idle, is no matter of its schedule
    assert [see(k) for k in range(28, 33)] == [""] * 4 + [LASERS_UNTOLD]
    assert "schedule" not in LASERS_UNTOLD and see(33, **mixed) == LASERS_MIXED


@pytest.mark.parametrize(
    ("is_free", "apart_ns", "exposed_ns", "said"),
    [
        (True, SAME_TIME_NS, 0, ""),
        (True, SAME_TIME_NS + 1, 0, TIMES_APART),
        # one wire: transports differ, exposures may not
        (False, 7_000_000, 400_000, ""),
        (False, 0, 2_400_001, EXPOSED_APART),
        (False, 0, 0, ""),
    ],
)
def test_cameras_that_do_not_see_one_moment_are_told_of(
    is_free: bool, apart_ns: int, exposed_ns: int, said: str
) -> None:
    watch = IdWatch(is_triggered=False, has_controller=False, is_free=is_free)
    pair = tuple(replace(frame(1, None), exposure_ns=one) for one in (400_000, exposed_ns))
    one = MatchedInstant(
        pair, STEP_NS, (), None, None, PoseStatus.GAP, times_ns=(STEP_NS, STEP_NS + apart_ns)
    )
    assert watch.see_pair(one) == said
    assert watch.see_pair(replace(one, frames=(None, pair[1]))) == ""


class Dated(Device):
    """What it hands out arrived when it says, so that no test waits for two seconds."""

    sources = ("A",)

    def read(self, timeout_s: float) -> Any:
        return self.elements.pop(0) if self.elements else super().read(timeout_s)


def told_of(
    frames: list[Frame],
    samples: list[ArmSample] | None = None,
    *,
    has_lasers: bool = False,
    is_arm_first: bool = False,
) -> set[tuple[str, str]]:
    """Warnings of a session that reads frames, then samples of the arm, or the other way."""
    arm = None if samples is None else Dated("arm", [])
    lasers = Dated("lasers", []) if has_lasers else None
    description = RigDescription(("c",), is_common_trigger=arm is not None)
    camera = Dated("camera 0", [] if is_arm_first else list(frames))
    rig: Any = Rig([camera], arm, lasers, description)  # type: ignore[list-item, arg-type]
    session = LiveSession(rig, options=ALL)
    told: list[LiveEvent] = []
    session.add_listener(told.append)
    session.open()
    waited(lambda: is_arm_first or session.stream_counts[0].n_elements == len(frames))
    if arm is not None and samples:
        arm.elements = [(one,) for one in samples]
        waited(lambda: session.stream_counts[1].n_elements == len(samples))
    if is_arm_first:
        camera.elements = list(frames)
        waited(lambda: session.stream_counts[0].n_elements == len(frames))
    session.stop()
    return {(one.text, one.device) for one in told if one.kind == "warning"}


def times_ns(n: int) -> list[int]:
    """Half a second apart, the last one now."""
    now_ns = time.monotonic_ns()
    return [now_ns - STEP_NS * (n - 1 - k) for k in range(n)]


def test_a_session_tells_of_a_camera_without_ids() -> None:
    frames = [Frame(IMAGE, k, t_ns, t_ns) for k, t_ns in enumerate(times_ns(10))]
    assert told_of(frames, []) == {(FRAMES_WITHOUT, "camera 0")}
    assert told_of([replace(one, trigger_id=one.number) for one in frames], []) == set()


def test_a_session_tells_of_an_arm_without_ids() -> None:
    when = times_ns(10)
    frames = [Frame(IMAGE, k, t_ns, t_ns, trigger_id=k) for k, t_ns in enumerate(when[:1])]
    samples = [ArmSample(k, t_ns, t_ns) for k, t_ns in enumerate(when)]
    assert told_of(frames, samples) == {(SAMPLES_WITHOUT, "arm")}
    with_ids = [replace(one, trigger_id=one.number) for one in samples]
    assert told_of(frames, with_ids, is_arm_first=True) == set()
    # counts that were apart from the start, by more than there are samples
    begun = [replace(one, trigger_id=one.number + 30) for one in frames]
    assert told_of(begun, with_ids) == {(IDS_APART, "arm")}


@pytest.mark.parametrize(("is_common_trigger", "said"), [(True, set()), (False, {TIMES_APART})])
def test_cameras_that_ids_pair_are_not_free(is_common_trigger: bool, said: set[str]) -> None:
    """7 ms apart by their own clocks, as their transports are."""
    pairs = [
        [Frame(IMAGE, k, t_ns + late_ns, t_ns + late_ns, trigger_id=k) for k, t_ns in times]
        for times in [list(enumerate(times_ns(60)))]
        for late_ns in (-7_000_000, 0)
    ]
    cameras: Any = [Dated(f"camera {k}", frames) for k, frames in enumerate(pairs)]
    description = RigDescription(("c", "d"), trigger="free", is_common_trigger=is_common_trigger)
    session = LiveSession(Rig(cameras, description=description), options=ALL)
    told: list[LiveEvent] = []
    session.add_listener(told.append)
    session.open()
    waited(lambda: all(counts.n_elements == 60 for counts in session.stream_counts[:2]))
    session.stop()
    assert {one.text for one in told if one.kind == "warning"} == said


def test_a_session_tells_of_a_laser_controller_that_is_silent() -> None:
    frames = [Frame(IMAGE, k, t_ns, t_ns) for k, t_ns in enumerate(times_ns(100))]
    assert told_of(frames, has_lasers=True) == {(LASERS_UNTOLD, "lasers")}


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (ArmFlag.REFERENCED, ()),
        (ArmFlag.REFERENCED | ArmFlag.INACCURATE, ("its poses are inaccurate",)),
        (ArmFlag.REFERENCED | ArmFlag.END_STOP, ("it is at an end stop",)),
        (
            ArmFlag.REFERENCED | ArmFlag.END_STOP | ArmFlag.INACCURATE,
            ("its poses are inaccurate", "it is at an end stop"),
        ),
    ],
)
def test_what_an_arm_says_against_its_poses_is_told(flags: ArmFlag, said: tuple[str, ...]) -> None:
    arm = Device("arm", [(replace(sample(k, None), flags=flags),) for k in range(6)])
    rig: Any = Rig([Device("camera 0", [])], arm, None, RigDescription(("c",)))  # type: ignore[list-item, arg-type]
    session = LiveSession(rig, options=ALL)
    told: list[Any] = []
    session.add_listener(told.append)
    session.open()
    waited(lambda: session.stream_counts[1].n_elements == 6)
    session.stop()
    warned = [event.words for event in told if event.kind == "warning"]
    assert len(warned) == len(said)
    for text, part in zip(warned, said, strict=True):
        assert part in text and text.startswith("arm: ")
