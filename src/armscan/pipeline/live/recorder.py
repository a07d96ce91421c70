# SPDX-License-Identifier: Apache-2.0
"""What a live rig delivers, as one recording: the tables as they are read again, and beside them
events with the devices' own counts and times.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.devices.clocks import LARGEST_DRIFT, ElementStatus
from armscan.devices.matching import (
    ARRIVED_TOGETHER_NS,
    SAME_COUNT_NS,
    MatchedInstant,
    TimedSample,
)
from armscan.devices.protocols import Frame, LaserEvent
from armscan.errors import ArmscanError
from armscan.geometry.arrays import FloatArray
from armscan.pipeline.live.acquire import LiveEvent
from armscan.pipeline.live.rig import Rig
from armscan.records.recording import (
    LASER_UNKNOWN,
    NO_TRIGGER,
    UNTRIGGERED,
    ArmTrack,
    ExposureRow,
    PoseForm,
    Session,
)
from armscan.storage.arm import ARM_MODEL_FILE, arm_model_toml
from armscan.storage.recordings.mcap_folder import TAKEN_BACK
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions, WriterStatus

BATCH_NS = 100_000_000
"""Samples of the arm are written so many together."""
AHEAD_NS = 400_000_000
"""An arm that has come so far past an image, with a lesser id, counts otherwise than its camera. A
time by the arm's clock holds its whole least delay, and images wait half a second for samples."""
_REPEATED = (ElementStatus.DUPLICATE, ElementStatus.LATE)
_PAGE = 256


class CommonIds:
    """Tells which ids of triggers came with an image and with a sample of the arm of one trigger.

    Counts differ where a device was switched off. What bears one id is of one trigger if the later
    time is within `SAME_COUNT_NS` of the other, or, where its clock is not known and it is that of
    arrival, within `ARRIVED_TOGETHER_NS`. Of each id eight bytes are kept for images and as many
    for samples: the first time, negative if of arrival.
    """

    def __init__(self) -> None:
        self._first_ns: tuple[dict[int, array[int]], dict[int, array[int]]] = ({}, {})
        self._arm_id = self._arm_ns = -1
        self._device_ns = self._came_ns = -1
        self.is_found = False

    def see_sample(self, trigger_id: int, one: TimedSample) -> bool:
        """Take a sample; False if an image bears its id from another count."""
        self._arm_id, self._arm_ns = trigger_id, -1 if one.t_ns is None else one.t_ns
        came_ns, passed_ns = one.sample.t_host_ns, one.sample.t_device_ns - self._device_ns
        if self._came_ns >= 0 and passed_ns >= 0:
            # samples that a transport held back came when the arm's own clock says, at the latest
            longest_ns = round((1.0 + 2.0 * LARGEST_DRIFT) * passed_ns)
            came_ns = min(came_ns, self._came_ns + longest_ns)
        self._came_ns, self._device_ns = came_ns, one.sample.t_device_ns
        return self._see(trigger_id, one.t_ns, came_ns, is_arm=True)

    def see_frame(self, trigger_id: int, frame: Frame, instant: MatchedInstant) -> bool:
        """Take an image; False if the arm's count is another."""
        t_ns = instant.t_ns
        # of one count no later sample bears a lesser id
        is_ahead = t_ns is not None and self._arm_ns > t_ns + AHEAD_NS
        if is_ahead and self._arm_id < trigger_id:
            return False
        is_known = instant.has_sample
        return self._see(trigger_id, t_ns, frame.t_host_ns, is_arm=False, is_known=is_known)

    def _see(
        self,
        trigger_id: int,
        t_ns: int | None,
        t_host_ns: int,
        *,
        is_arm: bool,
        is_known: bool = False,
    ) -> bool:
        page, place = divmod(trigger_id, _PAGE)
        now = -max(t_host_ns, 1) if t_ns is None else max(t_ns, 1)
        own, others = self._first_ns[is_arm], self._first_ns[not is_arm]
        first = others[page][place] if page in others else 0
        if first:
            late_ns = abs(now) - abs(first)
            is_arrival = (now if late_ns > 0 else first) < 0
            most_ns = ARRIVED_TOGETHER_NS if is_arrival else SAME_COUNT_NS
            if not is_known and abs(late_ns) > most_ns:
                return False
            self.is_found = True
        times = own.get(page)
        if times is None:
            times = own[page] = array("q", bytes(8 * _PAGE))
        times[place] = times[place] or now
        return True


class LiveRecorder:
    """Writes a rig's streams to an MCAP file; see `armscan.pipeline.live.acquire.Recorder`.

    All times of the tables are this computer's; where ids of triggers decide they only order, and
    the recording says that its clocks are separate: nothing is placed by them. A frame that no
    table may place is written with its pixels, its flag (``incomplete``, ``no-time``, ``late``,
    ``back``) and the time of the frame before it, 0 for the first: whoever reads the recording sets
    it aside, and counts it. Where the arm counts its triggers from the first one again, the ids of
    the tables go on after those before, of its samples and of the frames that came since: no id is
    there twice.

    Parameters
    ----------
    path
        File to write; must not exist.
    rig
        Whose streams come; opened, its windows set.
    options
        How the file is written; defaults if None.

    Attributes
    ----------
    n_usable
        Frames that a reader can measure and, where there is an arm, place: none of the following.
    n_aside
        Frames that are kept and that no table places.
    n_untriggered
        Frames without a trigger's id where ids decide, as before the first trigger: they are
        listed, and get no pose.
    n_of_other_count, n_samples_of_other_count
        Frames that bear the id of a sample of another time, and samples that bear that of a frame:
        a device was switched off, or counts from elsewhere. They are listed without id, and the
        frames get no pose.
    n_laser_unknown
        Frames of which it is not known what lasers were on: they are listed, and not measured.
    n_samples, n_posed
        Samples of the arm, and those of them that tell where it was.
    """

    def __init__(self, path: Path, rig: Rig, *, options: WriterOptions | None = None) -> None:
        self.n_usable = self.n_aside = self.n_untriggered = self.n_laser_unknown = 0
        self.n_samples = self.n_posed = 0
        self.n_of_other_count = self.n_samples_of_other_count = 0
        self._writer = RecordingWriter(path, options)
        self._rig, self._is_triggered = rig, rig.description.is_common_trigger
        self._is_free = rig.description.is_free
        by_joints = rig.arm is not None and rig.arm.pose_form == "joints"
        self._form: PoseForm = "joints" if by_joints else "quaternion"
        self._session = Session(
            "scan",
            tuple(camera.setup for camera in rig.cameras),
            clock="separate" if self._is_triggered else "related",
            pose_form=self._form,
            is_simulated=rig.is_simulated,
        )
        self._index = 0
        self._last_ns = [0] * len(rig.cameras)
        self._last_sample_ns = -1
        self._last_device_ns = 0
        self._samples: list[TimedSample] = []
        self._samples_since_ns = 0
        self._first_ns, self._first_sample_ns = 2**63, -1
        self._arm_id = self._highest_id = -1
        self._ids_from = 0
        self._ids = CommonIds()

    def begin(self) -> None:
        """Make the file.

        Raises
        ------
        OutputError
            If it exists or cannot be made.
        """
        model = self._rig.arm_model
        documents = {} if model is None else {ARM_MODEL_FILE: arm_model_toml(model)}
        self._writer.begin(self._session, documents)

    @property
    def is_begun(self) -> bool:
        """Whether the file at the path is its own."""
        return self._writer.is_begun

    def status(self) -> WriterStatus:
        """How far the file is."""
        return self._writer.status()

    @property
    def n_exposures(self) -> int:
        """Exposures that came; the next one has this index."""
        return self._index

    @property
    def unplaced(self) -> tuple[str, str]:
        """Why no exposure can have a pose, and what to do; empty where some can, or without arm.

        It is known once the recording is closed.
        """
        is_apart = max(self._last_ns) < self._first_sample_ns or (
            self._last_sample_ns < self._first_ns
        )
        reasons = (
            (
                not self.n_samples,
                "the arm sent no sample",
                "see that the arm sends while images come",
            ),
            (
                not self.n_posed,
                f"none of {self.n_samples} samples of the arm has a pose",
                "reference the arm, let it send poses, or name its arm_model in rig.toml",
            ),
            (
                self._is_triggered and self._arm_id < 0,
                "no sample of the arm bears a trigger's id, and ids alone give poses",
                "let the arm send a sample with the id at each trigger, or record without "
                "is_common_trigger",
            ),
            (
                self._is_triggered and not self._ids.is_found,
                "no trigger's id is that of an image and of a sample of the arm that came with it",
                "let camera and arm count the same triggers from the same one on, or record "
                "without is_common_trigger",
            ),
            (
                not self._is_triggered and is_apart,
                "none came while the arm sent samples whose time is known",
                "see that the arm sends while images come",
            ),
        )
        if self._rig.arm is None:
            return "", ""
        return next(((fact, remedy) for is_so, fact, remedy in reasons if is_so), ("", ""))

    def take_back(self, since: int, until: int) -> None:
        """Have no reader list exposures that came, by index, ``until`` not among them.

        The file keeps them.
        """
        facts = {"since": since, "until": until}
        self._writer.add_event(time.monotonic_ns(), TAKEN_BACK, facts)

    def close(self) -> WriterStatus:
        """Write all that waits, and the file's end.

        Raises
        ------
        OutputError
            If the disk is full or refuses; says how much is safe.
        """
        try:
            self._write_samples()
        finally:
            status = self._writer.close()
        return status

    def hear(self, event: LiveEvent) -> None:
        """Keep what a session tells: faults, buttons, passes, settings."""
        facts = {"text": event.text, "device": event.device}
        # what happens after the file's end, or a full disk, is told to whoever sees to the scan
        with suppress(ArmscanError):
            self._writer.add_event(time.monotonic_ns(), event.kind, facts)

    def add_frame(self, camera: int, frame: Frame, status: ElementStatus) -> None:
        """Keep a frame's own count and times; its pixels come with its instant, if it has one."""
        facts: dict[str, Any] = {
            "camera": camera,
            "number": frame.number,
            "t_device_ns": frame.t_device_ns,
            "t_host_ns": frame.t_host_ns,
            "exposure_ns": frame.exposure_ns,
            "status": status.label,
            "trigger_id": frame.trigger_id,
        }
        self._writer.add_event(frame.t_host_ns, "frame", facts)
        self._write_old_samples()
        if status == ElementStatus.LATE:
            self._add(camera, frame, None, (), ["late"])

    def add_samples(self, samples: tuple[TimedSample, ...]) -> None:
        """Keep those of the arm, some together."""
        if not self._samples:
            self._samples_since_ns = time.monotonic_ns()
        self._samples += map(self._numbered, samples)
        self._write_old_samples()

    def _write_old_samples(self) -> None:
        # by now, not by the next sample: that of an arm which sends one a posture is a minute away
        if self._samples and time.monotonic_ns() - self._samples_since_ns >= BATCH_NS:
            self._write_samples()

    def _numbered(self, one: TimedSample) -> TimedSample:
        """A sample with the id that the tables give its trigger."""
        number = one.sample.trigger_id
        if number is None or not self._is_triggered or one.status in _REPEATED:
            return one
        if number < self._arm_id:
            self._ids_from = self._highest_id + 1
        self._arm_id = number
        trigger_id = self._ids_from + number
        self._highest_id = max(self._highest_id, trigger_id)
        if self._ids.see_sample(trigger_id, one):
            return replace(one, sample=replace(one.sample, trigger_id=trigger_id))
        self.n_samples_of_other_count += 1
        return replace(one, sample=replace(one.sample, trigger_id=None))

    def add_events(self, events: tuple[LaserEvent, ...]) -> None:
        """Keep what was on, with the controller's own count and times."""
        for event in events:
            facts = {
                "trigger_id": event.trigger_id,
                "t_device_ns": event.t_device_ns,
                "t_host_ns": event.t_host_ns,
                "lasers": list(event.lasers),
            }
            self._writer.add_event(event.t_host_ns, "lasers", facts)

    def add_instant(self, instant: MatchedInstant) -> None:
        """Write its images."""
        for camera, delivered in enumerate(instant.frames):
            if delivered is None:
                continue
            frame = delivered
            # where ids decide, or there is no arm, a time orders the exposures and places nothing
            may_guess = self._is_triggered or self._rig.arm is None
            t_ns = frame.t_host_ns if instant.t_ns is None and may_guess else instant.t_ns
            if self._is_free and instant.times_ns:
                t_ns = instant.times_ns[camera] or t_ns
            flags = [] if frame.is_complete else ["incomplete"]
            flags += ["no-time"] if t_ns is None else []
            is_usable = frame.is_complete and t_ns is not None
            if self._is_triggered and frame.trigger_id is None:
                flags.append(UNTRIGGERED)
                self.n_untriggered += 1
            elif is_usable and self._is_of_other_count(frame, instant):
                frame = replace(frame, trigger_id=None)
                flags.append(UNTRIGGERED)
                self.n_of_other_count += 1
            if instant.lasers is None and self._rig.lasers is not None:
                flags.append(LASER_UNKNOWN)
                self.n_laser_unknown += is_usable
            spoiled = {LASER_UNKNOWN, UNTRIGGERED} if self._rig.arm is not None else {LASER_UNKNOWN}
            lasers = instant.lasers or ()
            is_listed = self._add(camera, frame, t_ns if is_usable else None, lasers, flags)
            self.n_usable += is_listed and spoiled.isdisjoint(flags)

    def _is_of_other_count(self, frame: Frame, instant: MatchedInstant) -> bool:
        if not self._is_triggered or self._rig.arm is None or frame.trigger_id is None:
            return False
        return not self._ids.see_frame(self._ids_from + frame.trigger_id, frame, instant)

    def _add(
        self,
        camera: int,
        frame: Frame,
        t_ns: int | None,
        lasers: tuple[str, ...],
        flags: Sequence[str],
    ) -> bool:
        """Write a frame; whether a table lists it."""
        last_ns = self._last_ns[camera]
        if t_ns is not None and t_ns <= last_ns:
            # a clock that was related anew; by time such a frame belongs nowhere
            t_ns, flags = (last_ns + 1, flags) if self._is_triggered else (None, [*flags, "back"])
        self.n_aside += t_ns is None
        trigger_id = None
        if self._is_triggered and frame.trigger_id is not None:
            trigger_id = self._ids_from + frame.trigger_id
            self._highest_id = max(self._highest_id, trigger_id)
        if t_ns is not None:
            self._first_ns = min(self._first_ns, t_ns)
        row = ExposureRow(
            self._index,
            last_ns if t_ns is None else t_ns,
            camera,
            f"images/{self._index:06d}.png",
            lasers,
            trigger_id,
        )
        # reconstruct takes images of a rig without controller as lit, too
        is_lit = self._rig.lasers is None and frame.lasers is None
        self._writer.add_exposure(row, frame.image, flags, is_lit=is_lit)
        self._index += 1
        self._last_ns[camera] = max(row.t_ns, last_ns)
        return t_ns is not None

    def _write_samples(self) -> None:
        samples, self._samples = self._samples, []
        if not samples:
            return
        own = [one.sample for one in samples]
        self.n_samples += len(own)
        self.n_posed += sum(map(self._is_posed, samples))
        facts: dict[str, Any] = {
            "number": [one.number for one in own],
            "t_device_ns": [one.t_device_ns for one in own],
            "t_host_ns": [one.t_host_ns for one in own],
            "buttons": [one.buttons for one in own],
            "flags": [int(one.flags) for one in own],
            "status": [one.status.label for one in samples],
        }
        self._writer.add_event(own[0].t_host_ns, "samples", facts)
        track = self._track(samples)
        if track is not None:
            self._writer.add_arm_samples(track)

    def _track(self, samples: Sequence[TimedSample]) -> ArmTrack | None:
        """Samples that have a time, in order; None if none has."""
        times, kept = [], []
        for one in samples:
            t_ns = one.t_ns
            if self._is_triggered and one.status not in _REPEATED:
                t_ns = self._ordered_ns(one)
            if t_ns is not None and t_ns > self._last_sample_ns:
                times.append(t_ns)
                kept.append(one)
                self._last_sample_ns = t_ns
                if self._first_sample_ns < 0:
                    self._first_sample_ns = t_ns
        if not kept:
            return None
        n = len(kept)
        rotations, places = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for k, one in enumerate(kept):
            if one.pose is not None:
                rotations[k], places[k] = one.pose.rotation, one.pose.translation_mm
        ids = [one.sample.trigger_id for one in kept] if self._is_triggered else [None] * n
        return ArmTrack(
            t_ns=np.array(times, dtype=np.int64),
            rotations=rotations,
            translations_mm=places,
            is_known=np.array([one.pose is not None for one in kept], dtype=np.bool_),
            trigger_ids=np.array([NO_TRIGGER if one is None else one for one in ids]),
            joints_rad=self._joints(kept),
        )

    def _ordered_ns(self, one: TimedSample) -> int:
        """A sample's time; where that is not sure, what the arm's clock says since the last one.

        Ids place the exposures, so such a time only orders. That of arrival would not do: of what
        came together one sample would lie upon the other, as if the arm had jumped. It is the
        latest that can be, and all that there is where the arm's clock begins anew.
        """
        t_ns, t_device_ns = one.t_ns, one.sample.t_device_ns
        if t_ns is None:
            t_ns, passed_ns = one.sample.t_host_ns, t_device_ns - self._last_device_ns
            if self._last_sample_ns >= 0 and passed_ns > 0:
                t_ns = min(t_ns, self._last_sample_ns + passed_ns)
        self._last_device_ns = t_device_ns
        return max(t_ns, self._last_sample_ns + 1)

    def _is_posed(self, one: TimedSample) -> bool:
        """Whether the table tells where the arm was, to whoever has its document."""
        if self._form != "joints":
            return one.pose is not None
        return one.sample.joints_rad is not None and one.sample.is_valid

    def _joints(self, samples: Sequence[TimedSample]) -> FloatArray | None:
        """(N, J) angles as delivered, NaN where they are not valid; None where none are given."""
        given = [one.sample.joints_rad for one in samples]
        is_form = self._form == "joints"
        n_joints = max((len(one) for one in given if one is not None), default=int(is_form))
        if not n_joints:
            return None
        angles = np.full((len(samples), n_joints), np.nan)
        for k, (one, own) in enumerate(zip(samples, given, strict=True)):
            if own is not None and one.sample.is_valid:
                angles[k, : len(own)] = own
        return angles
