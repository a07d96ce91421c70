# SPDX-License-Identifier: Apache-2.0
"""A folder recording as a source of a scan: read with images, poses and one clock for both, or
written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, FileFormatError, InputError, OptionError
from armscan.geometry.arrays import BoolArray, ImageArray, IntArray
from armscan.models.arm import ArmModel
from armscan.records.exposure import Exposure
from armscan.records.recording import (
    NO_TRIGGER,
    ArmTrack,
    CameraSetup,
    ExposureRow,
    PixelColour,
    Session,
)
from armscan.storage.arm import (
    ARM_FILE,
    ARM_MODEL_FILE,
    ArmTable,
    arm_columns,
    arm_model_toml,
    read_arm_model,
    read_arm_table,
)
from armscan.storage.files import (
    files_in,
    holds_files,
    is_file,
    new_folder,
    packed_notes,
    packed_place,
    read_bytes,
)
from armscan.storage.image_paths import are_simulated
from armscan.storage.images import ImageOptions, read_exposure
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    FLAGS,
    IS_WINDOW,
    SESSION_FILE,
    WINDOW_KEYS,
    SessionFile,
    check_files,
    exposure_columns,
    exposure_rows,
    is_inside,
    read_session_file,
    repeated_files,
    session_toml,
)
from armscan.storage.tables import CsvTable, csv_bytes, read_csv

Times: TypeAlias = IntArray | NDArray[np.float64]

SPAN_RATIO = 50
"""Spans of exposures and arm that differ more than so are suspected of two units."""
UNIT_FACTORS = (1_000, 1_000_000, 1_000_000_000)
"""Nanoseconds in a microsecond, a millisecond, a second."""
CROWD = 3
"""So many arrangements between two samples of the arm are warned of."""
FEWEST_STEPS, FASTEST_NS = 4, 20_000
"""Of so many steps and more, in the median, neither a camera nor an arm is as fast."""


def check_clock(
    rows: Sequence[ExposureRow], arm: ArmTrack, said: SessionFile, folder: Path
) -> tuple[list[str], list[str]]:
    """Refuse a recording whose poses cannot be found; tell what is assumed, and odd, in words.

    Raises
    ------
    FileFormatError
        If no trigger id is in both tables, no exposure is within the arm's times, or one table's
        times are in another unit.
    """
    where = str(folder / EXPOSURES_FILE)
    ids = {row.trigger_id for row in rows} - {None}
    of_arm = set() if arm.trigger_ids is None else set(arm.trigger_ids.tolist()) - {NO_TRIGGER}
    if ids & of_arm:
        return [], []
    if ids and of_arm:
        raise FileFormatError(
            "no trigger_id is in both tables",
            where=where,
            remedy="write the number of one trigger into both tables, or leave the columns out",
        )
    if said.session.clock == "separate":
        return [], ["cameras and arm have neither a shared clock nor trigger ids: no pose is known"]
    times = np.array([row.t_ns for row in rows], dtype=np.int64)
    warnings = _unit_warning(times, arm.t_ns, len({row.arrangement for row in rows}), where)
    if not _is_within(times, arm.t_ns).any():
        raise FileFormatError(
            f"no exposure ({times[0]} to {times[-1]} ns) is within the arm's times "
            f"({arm.t_ns[0]} to {arm.t_ns[-1]} ns)",
            where=where,
            remedy="write both times in nanoseconds of one clock, or record trigger ids",
        )
    warnings += _haste_warning(times, arm.t_ns, where)
    warnings += _crowd_warning(rows, arm.t_ns, where)
    return ([] if "time.clock" in said.stated else ["cameras and arm share one clock"]), warnings


def _is_within(times: Times, span: Times) -> BoolArray:
    return np.asarray((times >= span[0]) & (times <= span[-1]))


def _unit_warning(times: IntArray, arm_ns: IntArray, n_arrangements: int, where: str) -> list[str]:
    """Refuse times of another unit; a sentence where a short burst of images looks the same."""
    found = _wrong_unit(times.astype(np.float64), arm_ns.astype(np.float64))
    if found is None:
        return []
    table, factor = found
    seconds = [float(span[-1] - span[0]) / 1e9 for span in (times, arm_ns)]
    fact = (
        f"the exposures span {seconds[0]:.3g} s and the arm's samples {seconds[1]:.3g} s; the "
        f"exposures would be within the arm's times if t_ns of {table} were {factor:,} times as "
        "large"
    )
    is_burst = table == EXPOSURES_FILE and bool(_is_within(times, arm_ns).any())
    step_ns = np.median(np.diff(times)) if is_burst else 0.0
    if is_burst and (n_arrangements < CROWD or step_ns >= np.median(np.diff(arm_ns))):
        return [f"{where}: {fact}: are both in nanoseconds?"]
    raise FileFormatError(
        fact,
        where=where,
        remedy="write both times in nanoseconds; if they are, leave out the arm's samples long "
        "before and after the exposures, or record trigger ids",
    )


def _wrong_unit(times: Times, arm_ns: Times) -> tuple[str, int] | None:
    """The table whose times need a factor to agree with the other's, and the factor."""
    span, arm_span = float(times[-1] - times[0]), float(arm_ns[-1] - arm_ns[0])
    if min(span, arm_span) <= 0.0 or max(span, arm_span) < SPAN_RATIO * min(span, arm_span):
        return None
    is_shorter = span < arm_span
    for factor in UNIT_FACTORS:
        scaled, reference = (factor * times, arm_ns) if is_shorter else (times, factor * arm_ns)
        ratio = float((scaled[-1] - scaled[0]) / (reference[-1] - reference[0]))
        if 1.0 / SPAN_RATIO < ratio < SPAN_RATIO and _is_within(scaled, reference).mean() > 0.5:
            return (EXPOSURES_FILE if is_shorter else ARM_FILE), factor
    return None


def _haste_warning(times: IntArray, arm_ns: IntArray, where: str) -> list[str]:
    """A sentence where both tables are faster than any camera and any arm."""
    steps_ns = [np.diff(np.unique(span)) for span in (times, arm_ns)]
    if any(len(one) < FEWEST_STEPS or np.median(one) > FASTEST_NS for one in steps_ns):
        return []
    exposures_ns, samples_ns = (float(np.median(one)) for one in steps_ns)
    return [
        f"{where}: exposures follow each other by {exposures_ns:g} ns and the arm's samples by "
        f"{samples_ns:g} ns: are both times in nanoseconds?"
    ]


def _crowd_warning(rows: Sequence[ExposureRow], arm_ns: IntArray, where: str) -> list[str]:
    """A sentence if the arm was sampled far more seldom than images were taken."""
    times = np.array([row.t_ns for row in rows], dtype=np.int64)
    step = np.searchsorted(arm_ns, times, side="right")
    seen = [
        (int(k), row.arrangement) for k, row in zip(step, rows, strict=True) if 0 < k < len(arm_ns)
    ]
    count = Counter(k for k, _ in set(seen))
    if not count or max(count.values()) < CROWD:
        return []
    first, most = next(item for item in count.items() if item[1] == max(count.values()))
    return [
        f"{where}: {most} exposures fall between the same two samples of the arm (t_ns "
        f"{arm_ns[first - 1]} and {arm_ns[first]}): are both times in nanoseconds, and are all "
        "samples in the table?"
    ]


_FILTER, _NO_FILTER = 19, 8
"""IMWRITE_PNG_FILTER and its value for none; an OpenCV before 4.11 passes over them."""
PNG_WAY = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(_FILTER, _NO_FILTER),
)
"""Sensor noise leaves nothing to predict or repeat: without either, files are written twice as fast
and are no larger."""


BITS_REMEDY = (
    'correct bits_used of the [[camera]] in session.toml, and align ("high" where the bits are the '
    "upper ones of 16)"
)


def read_recorded(folder: Path, row: ExposureRow, setup: CameraSetup) -> Exposure:
    """Read the image of a row; a Bayer pattern is turned into red, green and blue.

    The pattern ``bayer_rggb`` begins with red at the image's top-left pixel, wherever the window
    lies.

    Raises
    ------
    OptionError
        If pixels exceed the stated bits.
    """
    path = folder / row.source
    options = ImageOptions(setup.bits_used, setup.align)
    try:
        image = read_exposure(path, options, source=row.source)
    except OptionError as error:
        raise OptionError(error.what, where=error.where, remedy=BITS_REMEDY) from error
    _check_layout(image, setup, path)
    _check_size(image, setup, path)
    pixels = image.image if setup.colour != "bayer_rggb" else demosaiced(image.image)
    return Exposure(
        pixels,
        row.source,
        bits_used=image.bits_used,
        window=setup.window,
        sensor_px=_sensor_px(image, setup),
        lasers=row.lasers,
        t_ns=row.t_ns,
        camera=row.camera,
        trigger_id=row.trigger_id,
        view=row.view,
    )


def setup_of_image(path: Path, setup: CameraSetup, lacking: Sequence[str]) -> CameraSetup:
    """Complete by one of its images what is lacking: what nobody said about a camera."""
    bits = None if "bits_used" in lacking else setup.bits_used
    image = read_exposure(path, ImageOptions(bits, setup.align))
    found: dict[str, Any] = {key: getattr(image, key) for key in lacking}
    return replace(setup, **found)


def window_note(path: Path, setup: CameraSetup) -> str:
    """A sentence if an image is smaller than its camera, whose window nobody said; else empty.

    An image that cannot be read is no matter of this note; it is named when it is asked for.
    """
    try:
        image = read_exposure(path)
    except ArmscanError:
        return ""
    size = (setup.width_px or image.width_px, setup.height_px or image.height_px)
    is_larger = image.width_px > size[0] or image.height_px > size[1]
    if is_larger or (image.width_px, image.height_px) == size:
        return ""
    return (
        f"{path.name} with {image.width_px} x {image.height_px} px is a window at "
        f"{setup.window.x_px}, {setup.window.y_px} of the camera's {size[0]} x {size[1]} px; "
        "window_x_px and window_y_px say where it begins"
    )


def encoded_png(exposure: Exposure, setup: CameraSetup) -> bytes:
    """PNG of an exposure, little compressed: lossless and quick.

    Raises
    ------
    InputError
        If its bits, layout or window are not those of the camera.
    """
    said = (setup.bits_used, setup.colour, setup.window)
    has = (exposure.bits_used, exposure.colour, exposure.window)
    if said != has:
        raise InputError(
            f"the exposure has bits, colour and window {has}, its camera {said}",
            where=exposure.source,
        )
    pixels: NDArray[Any] = exposure.image
    stored = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
    is_encoded, content = cv2.imencode(".png", stored, PNG_WAY)
    if not is_encoded:
        raise InputError("the image cannot be encoded as PNG", where=exposure.source)
    return bytes(content.tobytes())


def demosaiced(mosaic: ImageArray) -> ImageArray:
    """Red, green and blue (H, W, 3) of a Bayer pattern (H, W) that begins with red."""
    colour: NDArray[Any] = cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB)
    return colour.astype(np.uint8) if mosaic.dtype == np.uint8 else colour.astype(np.uint16)


def _check_layout(image: Exposure, setup: CameraSetup, path: Path) -> None:
    wanted = "rgb" if setup.colour == "rgb" else "mono"
    if image.colour != wanted:
        channels = "three channels" if image.colour == "rgb" else "one channel"
        raise FileFormatError(
            f"the image has {channels}, but its camera is '{setup.colour}'",
            where=str(path),
            remedy="correct colour under [[camera]] in session.toml",
        )


def _sensor_px(image: Exposure, setup: CameraSetup) -> tuple[int, int] | None:
    """The camera's size where it holds the image's window; else it is that of the window."""
    if setup.width_px is None or setup.height_px is None:
        return None
    window = setup.window
    right = window.x_px + window.binning * image.width_px
    bottom = window.y_px + window.binning * image.height_px
    is_inside = right <= setup.width_px and bottom <= setup.height_px
    return (setup.width_px, setup.height_px) if is_inside else None


def _check_size(image: Exposure, setup: CameraSetup, path: Path) -> None:
    """An image has its camera's size, or is smaller and lies inside it at the window's place."""
    have = np.array([image.width_px, image.height_px])
    if setup.width_px is None or setup.height_px is None:
        return
    size = np.array([setup.width_px, setup.height_px])
    corner = np.array([setup.window.x_px, setup.window.y_px])
    is_whole = bool((have == size).all())
    if not is_whole and _sensor_px(image, setup) is None:
        place = f" with a window at {corner[0]}, {corner[1]}" if corner.any() else ""
        raise FileFormatError(
            f"the image is {have[0]} x {have[1]} px, its camera {size[0]} x {size[1]} px{place}",
            where=str(path),
            remedy="correct the sizes in session.toml, or leave images of another camera out",
        )


SIZE_KEYS = ("width_px", "height_px")
CAMERA_KEYS = (*SIZE_KEYS, "bits_used", "colour")


@dataclass(frozen=True, slots=True, eq=False)
class FolderRecording:
    """A folder recording: a `ScanSource` whose images are read when they are asked for.

    Parameters
    ----------
    is_simulated
        True if it, or a mark beside it, says that its images were rendered.
    exposure_columns, arm_columns
        Columns of the tables that are not known, in the order of ``rows`` and of the samples.
    arm_model
        Geometry with which joint angles were turned into poses; None where it was not needed.
    """

    folder: Path
    session: Session
    rows: tuple[ExposureRow, ...]
    arm: ArmTrack | None
    is_simulated: bool
    warnings: tuple[str, ...]
    exposure_columns: Mapping[str, tuple[str, ...]]
    arm_columns: Mapping[str, tuple[str, ...]]
    arm_model: ArmModel | None

    @property
    def name(self) -> str:
        """As `recording_name`."""
        return recording_name(self.folder)

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]`` with its pixels."""
        chosen = self.rows[row]
        return read_recorded(self.folder, chosen, self.session.cameras[chosen.camera])


def recording_name(folder: Path) -> str:
    """The folder's name; of a recording in one file that of the file without its suffix."""
    path = folder.resolve()
    return path.name if packed_place(path) is None else path.stem


def is_recording(folder: Path) -> bool:
    """True for a folder that holds the list of a recording's exposures, and for one in one file."""
    packed = packed_place(folder)
    return is_file(folder / EXPOSURES_FILE) if packed is None else not packed[1]


def recording_tables(folder: Path, other_arm: Path | None = None) -> tuple[Path, ...]:
    """Its list of exposures, its arm's samples and geometry and its session, if there are any.

    Where another geometry is used, that stands last, and its own is left out.
    """
    names = (EXPOSURES_FILE, ARM_FILE, "" if other_arm else ARM_MODEL_FILE, SESSION_FILE)
    own = tuple(path for path in (folder / name for name in names if name) if is_file(path))
    return own if other_arm is None else (*own, other_arm)


def camera_tables(folder: Path) -> tuple[Path, ...]:
    """Those of `recording_tables` that say something of the images."""
    of_arm = {ARM_FILE, ARM_MODEL_FILE}
    return tuple(path for path in recording_tables(folder) if path.name not in of_arm)


def read_recording(folder: Path, arm: ArmModel | None = None) -> FolderRecording:
    """Read a folder recording, or the one in an MCAP file; images are read later, one by one.

    ``arm`` turns joint angles into poses, ``arm.toml`` of the recording if None.
    """
    _check_folder(folder)
    table = read_csv(folder / EXPOSURES_FILE)
    rows, unknown = exposure_rows(table)
    check_files(folder, rows)
    said, assumed = _said(folder)
    warnings = [*packed_notes(folder), *said.warnings, *_odd(table, unknown)]
    warnings += [f"{table.where}: {name} is listed again" for name in repeated_files(rows)]
    track, form, arm_model, arm_unknown = None, said.session.pose_form, None, {}
    if is_file(folder / ARM_FILE):
        arm_csv = read_csv(folder / ARM_FILE)
        arm_model = arm if arm is not None else _own_arm_model(folder)
        found = _arm_table(arm_csv, said, arm_model)
        track, form, arm_unknown = found.track, found.form, dict(found.extra)
        warnings += [*_odd(arm_csv, arm_unknown), *found.warnings]
        assumed += _assumed_of_arm(found, said)
        of_clock, odd_times = check_clock(rows, track, said, folder)
        assumed += of_clock
        warnings += odd_times
    cameras, facts = _cameras(folder, rows, said)
    session = replace(said.session, cameras=cameras, pose_form=form, assumed=(*assumed, *facts))
    warnings += _odd_head(folder, session.head)
    return FolderRecording(
        folder,
        session,
        rows,
        track,
        session.is_simulated or are_simulated((folder / EXPOSURES_FILE,)),
        tuple(warnings),
        unknown,
        arm_unknown,
        arm_model,
    )


def read_arm_track(folder: Path) -> tuple[ArmTrack, tuple[str, ...]]:
    """Read what the arm reported, from a folder with or without images.

    Parameters
    ----------
    folder
        Holds ``arm.csv``, as a rule ``session.toml``, and ``arm.toml`` for joint angles.

    Returns
    -------
    track
        The samples.
    notes
        What is odd in the files or was assumed, in words.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged or against a rule of the format.
    """
    said, notes = _said(folder)
    table = read_csv(folder / ARM_FILE)
    found = _arm_table(table, said, _own_arm_model(folder))
    notes += [*said.warnings, *_odd(table, found.extra), *found.warnings]
    return found.track, (*notes, *_assumed_of_arm(found, said))


def _said(folder: Path) -> tuple[SessionFile, list[str]]:
    """The session, and that there is none if there is none."""
    path = folder / SESSION_FILE
    if is_file(path):
        return read_session_file(path), []
    return SessionFile(Session(cameras=())), [f"there is no {SESSION_FILE}"]


def _check_folder(folder: Path) -> None:
    if not holds_files(folder):
        raise FileFormatError(
            "there is no such folder", where=str(folder), remedy="name a recording's folder"
        )
    if packed_place(folder) is not None:
        files_in(folder)
    if not is_file(folder / EXPOSURES_FILE):
        raise FileFormatError(
            f"the folder holds no {EXPOSURES_FILE}, so it is no recording",
            where=str(folder),
            remedy="name the folder that holds it, or list the images in one",
        )


def _own_arm_model(folder: Path) -> ArmModel | None:
    path = folder / ARM_MODEL_FILE
    return read_arm_model(path) if is_file(path) else None


def _arm_table(table: CsvTable, said: SessionFile, arm: ArmModel | None) -> ArmTable:
    form = said.session.pose_form if "pose.form" in said.stated else None
    return read_arm_table(table, form, said.session.rotation, arm)


def _assumed_of_arm(found: ArmTable, said: SessionFile) -> list[str]:
    facts = []
    if "pose.form" not in said.stated:
        facts.append(f"the arm's poses are of the form '{found.form}', by their columns")
    if found.form == "euler" and "pose.rotation" not in said.stated:
        facts.append(f"Euler angles are '{said.session.rotation}'")
    return facts


def _odd_head(folder: Path, head: str | None) -> list[str]:
    where = str(folder / SESSION_FILE)
    if head is None or (is_inside(head) and is_file(folder / head)):
        return []
    if not is_inside(head):
        raise FileFormatError(
            f"head is '{head}', no path inside the recording",
            where=where,
            remedy="copy the file into the recording and name it relative to that",
        )
    return [f"{where}: there is no file {head}"]


def _odd(table: CsvTable, unknown: Mapping[str, tuple[str, ...]]) -> list[str]:
    found = []
    odd = [name for name in unknown if name != FLAGS]
    if odd:
        found.append(f"{table.where}: columns not known, kept: {', '.join(odd)}")
    if table.is_cut:
        found.append(
            f"{table.where}: the last line does not end with a line break, so the file may be cut"
        )
    return found


def _cameras(
    folder: Path, rows: Sequence[ExposureRow], said: SessionFile
) -> tuple[tuple[CameraSetup, ...], list[str]]:
    """Setups of all cameras as said, what nobody said by the first image of each; and that."""
    count = max(row.camera for row in rows) + 1
    setups = said.session.cameras
    if setups and count > len(setups):
        raise FileFormatError(
            f"camera {count - 1} is not among the {len(setups)} cameras of {SESSION_FILE}",
            where=str(folder / EXPOSURES_FILE),
            remedy="count cameras from 0, and describe each under [[camera]]",
        )
    cameras, facts = [], []
    for number in range(len(setups) or count):
        setup = setups[number] if setups else CameraSetup()
        prefix = f"camera.{number}."
        stated = frozenset(
            key.removeprefix(prefix) for key in said.stated if key.startswith(prefix)
        )
        first = next((row for row in rows if row.camera == number), None)
        # a camera that is described takes the format's defaults, one that is not its images'
        lacking = [key for key in (CAMERA_KEYS if not setups else SIZE_KEYS) if key not in stated]
        if first is not None and lacking:
            setup = setup_of_image(folder / first.source, setup, lacking)
            values = ", ".join(f"{key} {getattr(setup, key)}" for key in lacking)
            facts.append(f"camera {number} has {values}, as {first.source}")
        is_placed = IS_WINDOW in stated or stated.issuperset(WINDOW_KEYS)
        if first is not None and not lacking and not is_placed:
            note = window_note(folder / first.source, setup)
            facts += [f"camera {number}: {note}"] if note else []
        cameras.append(setup)
    return tuple(cameras), facts


Report: TypeAlias = Callable[[int, int, str], None]


def write_recording(
    folder: Path,
    source: ScanSource,
    progress: Report | None = None,
    *,
    names: Sequence[str] | None = None,
    encoded: Iterable[bytes] | None = None,
    arm: ArmModel | None = None,
    beside: Mapping[Path, bytes] | None = None,
) -> None:
    """Write a scan as a folder recording, into a folder that does not exist or is empty.

    Everything is written into a folder of another name, which is renamed when it is complete; an
    interrupt or a full disk leaves nothing. Images of a folder recording are copied byte by byte,
    those of any other source are written as PNG, or as ``encoded`` (N,), where they were made
    already; see `encoded_png`. ``names`` (N,) are their paths inside the recording; if None their
    own names where those are paths of PNG files, else by index. ``progress`` is called with images
    written, images in all, and the name of the latest; files ``beside`` appear with the folder
    (`new_folder`).

    Raises
    ------
    InputError
        If an exposure is not what its session says.
    """
    session = written_session(source)
    rows = named_rows(source, names)
    contents = image_files(source, session) if encoded is None else encoded
    with new_folder(folder, beside) as partial:
        for done, (row, content) in enumerate(zip(rows, contents, strict=True), start=1):
            path = partial / row.source
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            if progress is not None:
                progress(done, len(rows), row.source)
        _write_tables(partial, source, session, rows, arm)


def written_session(source: ScanSource) -> Session:
    """The session as it is written: pixels are stored as exposures deliver them.

    A folder recording's images are copied, so that its session stays as it is.
    """
    session = replace(source.session, is_simulated=source.is_simulated)
    if isinstance(source, FolderRecording):
        return session
    return replace(session, cameras=tuple(_delivered(setup) for setup in session.cameras))


def _delivered(setup: CameraSetup) -> CameraSetup:
    colour: PixelColour = "mono" if setup.colour == "mono" else "rgb"
    return replace(setup, align="low", colour=colour)


def image_files(source: ScanSource, session: Session) -> Iterator[bytes]:
    """The image files of a scan as it is written, in the order of its rows."""
    for k, row in enumerate(source.rows):
        if isinstance(source, FolderRecording):
            yield read_bytes(source.folder / row.source)
        else:
            yield encoded_png(source.exposure(k), session.cameras[row.camera])


def named_rows(source: ScanSource, names: Sequence[str] | None = None) -> tuple[ExposureRow, ...]:
    """Rows with the names under which their images are written; see `write_recording`."""
    if isinstance(source, FolderRecording) and names is None:
        return source.rows
    chosen = [_png_name(row) for row in source.rows] if names is None else names
    rows = tuple(replace(row, source=name) for row, name in zip(source.rows, chosen, strict=True))
    if len({row.source for row in rows}) < len(rows):
        raise InputError("two images would have one name", where=source.name)
    return rows


def _png_name(row: ExposureRow) -> str:
    """Its own name if that is a PNG inside a recording, else one by its index."""
    path = PurePosixPath(row.source)
    is_usable = is_inside(row.source) and path.suffix == ".png" and len(path.parts) > 1
    return row.source if is_usable else f"images/{row.index:04d}.png"


def _write_tables(
    folder: Path,
    source: ScanSource,
    session: Session,
    rows: tuple[ExposureRow, ...],
    arm: ArmModel | None,
) -> None:
    extra = source.exposure_columns if isinstance(source, FolderRecording) else {}
    (folder / EXPOSURES_FILE).write_bytes(csv_bytes(exposure_columns(rows, extra)))
    if source.arm is not None:
        extra = source.arm_columns if isinstance(source, FolderRecording) else {}
        columns = arm_columns(source.arm, session.pose_form, session.rotation, extra)
        (folder / ARM_FILE).write_bytes(csv_bytes(columns))
    model = source.arm_model if isinstance(source, FolderRecording) and arm is None else arm
    if model is not None:
        (folder / ARM_MODEL_FILE).write_bytes(arm_model_toml(model))
    if isinstance(source, FolderRecording) and session.head is not None:
        head = source.folder / session.head
        if is_file(head):
            (folder / session.head).parent.mkdir(parents=True, exist_ok=True)
            (folder / session.head).write_bytes(read_bytes(head))
    (folder / SESSION_FILE).write_bytes(session_toml(session))
