# SPDX-License-Identifier: Apache-2.0
"""The measuring loop: instants come in, labelled stripes and points in the Sensor frame go out.

Still images, hand-eye calibration, scans and scans that choose their lasers meanwhile all drive
`measure_instants`; heads differ in their `StripeLabeller` alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from armscan.errors import ArmscanError, EstimationError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.calibration import LaserColour, SensorCalibration, without_covariance
from armscan.models.camera import CameraModel
from armscan.pipeline.instants import (
    ExposurePair,
    InstantImages,
    ScanInstants,
    check_sizes,
    checked_pairs,
    pair_exposures,
)
from armscan.pipeline.progress import (
    Progress,
    ProgressEvent,
    StageClock,
    count_cores,
    in_order,
    silent,
    worker_threads,
)
from armscan.reconstruction.label_cross import CrossLabeller, stripes_apart
from armscan.reconstruction.label_stereo import StereoLabeller
from armscan.reconstruction.labels import (
    LabelledProfile,
    PointStatus,
    SingleLabeller,
    StripeCounts,
    StripeLabeller,
    without_sheet,
)
from armscan.reconstruction.place import merge_clouds
from armscan.reconstruction.points import MeasuredProfile, measure_points, points_again
from armscan.reconstruction.triangulate import (
    CALIBRATED_DEPTHS,
    LABEL_DEPTHS,
    SOUGHT_DEPTHS,
    DepthRange,
    StripePoints,
    cloud_in_sensor,
)
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile, StripeFlag
from armscan.storage.detection_cache import DetectionCache, detection_key
from armscan.thesis.row_rule import RowLabeller
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions

STAGE = "reconstruct"
EXTRACTION, NAMING, PLACING = "extraction", "naming", "placing"
"""Stages whose processor time is told."""
TRIMMED_AFTER = 100
"""Instants after which the cache is kept small."""
LOOKED_AT, LEAST_LINE = 10, 30
"""Images of a scan of which the channel is judged, evenly spread, and points that make a line in
one: a glint in a single image decides nothing."""
LITTLE_SEEN = 0.7
"""Of the points that the laser's own channel shows: with fewer a difference of channels is left. On
lit boards of three public sets a difference shows 0.8 to 12 times as many, of lines that are white
in the middle 0.19 to 0.56."""
MOST_THREADS = 8
"""Instants whose stripes are extracted at the same time, if there are as many cores."""
CLEAN_SHARE = 0.5
"""An image of which less than this share of the stripe points is measured is pointed out."""
OPEN_SHARE = 0.25
"""If a larger share of the points may be of several sheets, the way of lighting does not suit."""
LISTED = 4
NOTHING_MEASURED_REMEDY = (
    "check that the images show a laser line, that camera and sheet are the right ones, and give a "
    "larger --depth-margin if the object stood further outside the calibrated depths"
)
RULE_OF_ROWS_REMEDY = (
    "give the recording of a scan, with scanner.json, that has each laser alone before both "
    "(column lasers of exposures.csv), or leave --method thesis out"
)


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """How stripes on objects become points.

    Parameters
    ----------
    stripes
        Stripe extraction.
    depths
        Depths that are accepted; points outside are left out and counted. None for those that the
        head's own rule takes.
    sheet
        Name of the sheet that drew all stripes; empty to find it. For one camera only. Exposures
        that name other calibrated lasers are left out.
    is_by_thesis
        Tell crossed sheets by the printed rule of rows (eqs. 3.1 to 3.7).
    """

    stripes: StripeOptions = field(default_factory=StripeOptions)
    depths: DepthRange | None = None
    sheet: str = ""
    is_by_thesis: bool = False

    def accepted_depths(self, sensor: SensorCalibration) -> DepthRange:
        """Depths in which points are kept."""
        return self.depths or (CALIBRATED_DEPTHS if sensor.second is None else LABEL_DEPTHS)


def labeller_for(
    sensor: SensorCalibration, options: MeasureOptions, *, is_scan: bool = False
) -> StripeLabeller:
    """The rule by which this sensor's stripes are given to sheets.

    Parameters
    ----------
    sensor
        Camera or cameras and sheets.
    options
        Depths accepted, and the user's choice of a sheet.
    is_scan
        True for exposures in order of time with the arm's pose; else each is labelled by itself.

    Raises
    ------
    OptionError
        If a sheet is chosen for two cameras, which tell the sheet of every stripe themselves, if
        there is no such sheet, or if the rule of rows is asked for and has nothing to tell.
    """
    n_sheets = len(sensor.sheets)
    if options.is_by_thesis:
        if sensor.second is not None or n_sheets < 2 or options.sheet:
            raise OptionError(
                "the rule of rows tells the sheets of one camera's crossed lines",
                where="--method thesis",
                remedy="leave it out",
            )
        return RowLabeller(sensor)
    if sensor.second is not None:
        if options.sheet:
            raise OptionError(
                f"sheet {options.sheet!r} was asked for, but two cameras tell each stripe's sheet",
                where="--sheet",
                remedy="leave --sheet out",
            )
        return StereoLabeller(sensor, SOUGHT_DEPTHS.or_wider(options.depths))
    if n_sheets > 1 and not options.sheet and (is_scan or stripes_apart(sensor).any()):
        return CrossLabeller(sensor, options.depths or LABEL_DEPTHS)
    depths = options.accepted_depths(sensor)
    return SingleLabeller(sensor, depths, options.sheet, options.depths or LABEL_DEPTHS)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredInstant:
    """One instant, and what each of its cameras gave."""

    images: InstantImages
    profiles: tuple[MeasuredProfile, ...]


def measure_instants(
    instants: Iterable[InstantImages],
    labeller: StripeLabeller,
    sensor: SensorCalibration,
    options: MeasureOptions,
    *,
    is_pass: bool,
    reads_ahead: bool = True,
    cache: DetectionCache | None = None,
    clock: StageClock | None = None,
) -> Iterator[MeasuredInstant]:
    """Extract the stripes of each instant, label them, and turn them into points.

    Parameters
    ----------
    instants
        In order of time; read one by one.
    labeller
        From `labeller_for`.
    sensor
        Camera or cameras and sheets.
    options
        Stripe extraction and the depths accepted.
    is_pass
        True where each instant follows the one before; else the labeller forgets it.
    reads_ahead
        Read and extract the next instants meanwhile; False where an exposure depends on the labels
        of the one before.
    cache
        Keeps the stripes of every image for another run; None to keep none.
    clock
        Counts what extraction and naming take.

    Raises
    ------
    InputError
        If an image is not of its camera's sensor.
    EstimationError
        If the sheet of a stripe is ambiguous.
    """
    clock = clock or StageClock()
    depths = options.accepted_depths(sensor)
    cameras, stripes = cameras_of(sensor), stripes_for(sensor, options.stripes)

    def extract_one(both: tuple[ExposurePair, CameraModel]) -> Profile:
        with clock.stage(EXTRACTION):
            return extract_profile(*both, stripes, cache)

    def extract(images: InstantImages) -> list[Profile]:
        if images.profiles:
            return list(images.profiles)
        return list(each_camera(extract_one, zip(images.pairs, cameras, strict=True)))

    with ExitStack() as stack:
        if cache is not None:
            stack.callback(cache.trim)
        # where no instant is read ahead the cameras of one are the work that there is at a time
        is_shared = not reads_ahead and len(cameras) > 1 and count_cores() > 1
        pool = stack.enter_context(worker_threads(len(cameras))) if is_shared else None
        each_camera = map if pool is None else pool.map
        n_ahead = MOST_THREADS if reads_ahead else 1
        for n, (images, profiles) in enumerate(in_order(extract, instants, n_ahead)):
            if not is_pass:
                labeller.reset()
            if cache is not None and n % TRIMMED_AFTER == 0:
                cache.trim()
            with clock.stage(NAMING):
                labelled = labeller.label(
                    profiles, images.lasers, images.base_from_sensor, images.t_ns
                )
            with clock.stage(PLACING):
                measured = MeasuredInstant(images, measure_points(labelled, sensor, depths))
            yield measured


def stripes_for(sensor: SensorCalibration, options: StripeOptions) -> StripeOptions:
    """The options with the channel in which the sensor was calibrated, unless one was chosen."""
    if options.laser_colour != "auto":
        return options
    return replace(options, laser_colour=cast(LaserColour, sensor.laser_colour))


def cached_profile(
    exposure: Exposure,
    options: StripeOptions | None = None,
    background: Exposure | None = None,
    cache: DetectionCache | None = None,
) -> Profile:
    """As `extract_stripes`; looks only if the cache does not know. None for no cache."""
    chosen = StripeOptions() if options is None else options
    if cache is None:
        return extract_stripes(exposure, chosen, background)
    key = detection_key("stripes", exposure, (chosen,), background)
    found = cache.get(key)
    if isinstance(found, Profile):
        return found
    looked = extract_stripes(exposure, chosen, background)
    cache.put(key, looked)
    return looked


def stripes_as_seen(
    n_exposures: int,
    pair_of: Callable[[int], ExposurePair],
    sensor: SensorCalibration,
    options: StripeOptions,
    cache: DetectionCache | None = None,
) -> tuple[StripeOptions, str]:
    """As `stripes_for`, in the laser's own channel where that shows the lines and others do not.

    A difference of channels shows a faint line on a lit board. In a darker scan the same line is
    white in the middle, where no channel exceeds another: of a difference the edges of its halo are
    left. In the laser's own channel a ridge counts only if its surroundings have that colour.

    ``pair_of`` reads one of ``n_exposures``; a few are looked at, and none unless the sensor was
    calibrated in a difference and no channel was chosen. With the options comes why they are not
    those of the calibration, in words; empty if they are.
    """
    calibrated = stripes_for(sensor, options)
    channel, _, other = calibrated.laser_colour.partition("-")
    if options.laser_colour != "auto" or not other:
        return calibrated, ""
    own = replace(calibrated, laser_colour=cast(LaserColour, channel))
    counts: list[tuple[int, int]] = []
    for k in sorted(
        {n * n_exposures // LOOKED_AT for n in range(LOOKED_AT)} & {*range(n_exposures)}
    ):
        try:
            lit, dark = pair_of(k)
        except ArmscanError:
            # the scan itself tells which it cannot read
            continue
        if lit.colour != "mono":
            n_own, n_calibrated = (
                int(cached_profile(lit, way, dark, cache).is_accepted.sum())
                for way in (own, calibrated)
            )
            if max(n_own, n_calibrated) >= LEAST_LINE:
                counts.append((n_own, n_calibrated))
    n_better = sum(1 for n_own, n in counts if n < LITTLE_SEEN * n_own)
    total, total_calibrated = np.array(counts).reshape(-1, 2).sum(axis=0)
    if 2 * n_better <= len(counts) or total_calibrated >= LITTLE_SEEN * total:
        return calibrated, ""
    return own, (
        f"the stripes are taken in {channel}, which shows {total} points of them in {len(counts)} "
        f"sampled images; {calibrated.laser_colour}, in which the sensor was calibrated, shows "
        f"{total_calibrated}, as of lines whose middle is white: --laser-colour chooses otherwise"
    )


def scan_as_seen(
    instants: ScanInstants,
    sensor: SensorCalibration,
    options: MeasureOptions,
    cache: DetectionCache | None = None,
) -> tuple[MeasureOptions, str]:
    """`stripes_as_seen` of the first camera's exposures with a laser on, and why if it differs."""
    lit = instants.lit
    stripes, about = stripes_as_seen(
        len(lit), lambda k: instants.pair(lit[k].rows[0]), sensor, options.stripes, cache
    )
    return (replace(options, stripes=stripes), about) if about else (options, "")


def extract_profile(
    pair: ExposurePair,
    camera: CameraModel,
    options: StripeOptions,
    cache: DetectionCache | None = None,
) -> Profile:
    """Extract the stripes of one exposure, or take them from the cache.

    Raises
    ------
    InputError
        If the image is not of the camera's sensor.
    """
    exposure, background = pair
    check_sizes([image for image in pair if image is not None], camera)
    return cached_profile(exposure, options, background, cache)


def cameras_of(sensor: SensorCalibration) -> tuple[CameraModel, ...]:
    """The sensor's camera or cameras, left first."""
    if sensor.second is None:
        return (sensor.camera.camera,)
    return sensor.camera.camera, sensor.second.camera.camera


def measured_again(
    profiles: Sequence[LabelledProfile],
    lasers: Sequence[tuple[str, ...]],
    sensor: SensorCalibration,
) -> Iterator[tuple[int, StripePoints]]:
    """Number and measured points of each profile of a scan: what it does not keep of them.

    ``lasers`` are those of each profile's exposure. Of a head of two cameras, the profiles of one
    instant follow each other.
    """
    if sensor.second is None:
        for k, labelled in enumerate(profiles):
            yield k, points_again(labelled, sensor)
        return
    labeller = StereoLabeller(sensor)
    for k in range(0, len(profiles) - 1, 2):
        both = profiles[k].profile, profiles[k + 1].profile
        labels = labeller.label(both, lasers[k] or lasers[k + 1])
        for camera, found in enumerate(measure_points(labels, sensor, LABEL_DEPTHS)):
            yield k + camera, found.points


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Measured points and the evidence of each image.

    Parameters
    ----------
    cloud
        Points in the Sensor frame.
    images
        One entry an exposure, in the order given; ``cloud.exposure`` points into it.
    warnings
        What is weak, in words.
    """

    cloud: PointCloud
    images: tuple[LabelledProfile, ...]
    warnings: tuple[str, ...] = ()


def reconstruct(
    exposures: Sequence[Exposure],
    sensor: SensorCalibration,
    *,
    backgrounds: Sequence[Exposure] = (),
    rights: Sequence[Exposure] = (),
    right_backgrounds: Sequence[Exposure] = (),
    are_paired: bool = False,
    options: MeasureOptions | None = None,
    progress: Progress = silent,
    cache: DetectionCache | None = None,
) -> Reconstruction:
    """Extract the stripes of every exposure, label their sheets and triangulate them.

    Parameters
    ----------
    exposures
        With the laser on, of the left camera or the only one; each is measured by itself.
    sensor
        Camera or cameras and sheets.
    backgrounds
        The same views without laser, one for each exposure, or none.
    rights, right_backgrounds
        The right camera's exposures of the same instants, in the same order, and theirs without
        laser; for a sensor of two cameras.
    are_paired
        True if the backgrounds are those of the exposures' views, in their order; else they are
        paired by file name where the names agree.
    options
        Defaults if None.
    progress
        Told of every image.
    cache
        Keeps the stripes of every image for another run; None to keep none.

    Raises
    ------
    InputError
        If images and backgrounds do not pair, are not of the camera's sensor, or if the images are
        not of as many cameras as the sensor has.
    EstimationError
        If the sheet of a stripe is ambiguous, or nothing was measured at all.
    """
    options = options or MeasureOptions()

    def paired(lit: Sequence[Exposure], dark: Sequence[Exposure]) -> list[ExposurePair]:
        return (checked_pairs if are_paired and dark else pair_exposures)(lit, dark)

    left = paired(exposures, backgrounds)
    _check_cameras(sensor, len(left), len(rights))
    cameras = [left] if sensor.second is None else [left, paired(rights, right_backgrounds)]
    images: list[LabelledProfile] = []
    clouds: list[PointCloud] = []
    weak: list[str] = []
    labeller = labeller_for(sensor, options)
    of_lasers = laser_warnings([one.lasers for one in exposures], labeller, sensor, options)
    stripes, about = stripes_as_seen(len(left), left.__getitem__, sensor, options.stripes, cache)
    options = replace(options, stripes=stripes)
    for instant in measure_instants(
        _stills(cameras, progress), labeller, sensor, options, is_pass=False, cache=cache
    ):
        for found in instant.profiles:
            images.append(found.labelled)
            weak += found.warnings
            clouds.append(cloud_in_sensor(found.points, found.labelled.profile, sensor))
    progress(ProgressEvent(STAGE, len(left), len(left)))
    cloud = merge_clouds(clouds)
    if len(cloud) == 0:
        counts = [image.counts for image in images]
        raise nothing_measured(counts, is_by_thesis=options.is_by_thesis)
    depths = SheetDepths.of(sensor)
    SheetDepths.add(depths, cloud.sheet, cloud.points_mm[:, 2])
    counts = [image.counts for image in images]
    said = (about, *of_lasers) if about else of_lasers
    warnings = (*said, *measurement_warnings(counts, depths, sensor), *summarised(weak))
    return Reconstruction(cloud, tuple(images), warnings)


def _stills(
    cameras: Sequence[Sequence[ExposurePair]], progress: Progress
) -> Iterator[InstantImages]:
    """Each exposure with its partner of the other camera, as an instant of its own."""
    for done, pairs in enumerate(zip(*cameras, strict=True)):
        progress(ProgressEvent(STAGE, done, len(cameras[0]), pairs[0][0].source))
        yield InstantImages(pairs)


def _check_cameras(sensor: SensorCalibration, n_left: int, n_right: int) -> None:
    """Raise `InputError` unless the images are of as many cameras as the sensor has."""
    if sensor.second is None and n_right:
        raise InputError(
            f"{n_right} images of a right camera, but the sensor has one camera",
            remedy="leave them out, or name the sensor of the stereo head",
        )
    if sensor.second is not None and n_right != n_left:
        raise InputError(
            f"{n_left} images of the left camera but {n_right} of the right one",
            remedy="give the right camera's image of every instant, in the same order",
        )


def nothing_measured(
    images: Sequence[StripeCounts], *, is_by_thesis: bool = False
) -> EstimationError:
    """Why these images gave no point at all, to be raised."""
    n_points = sum(map(len, images))
    if n_points == 0:
        return EstimationError(
            f"no stripe was found in {len(images)} images", remedy=NOTHING_MEASURED_REMEDY
        )
    n_stray, n_flagged = (
        sum(image.count(status) for image in images)
        for status in (PointStatus.STRAY, PointStatus.FLAGGED)
    )
    if is_by_thesis and n_stray and n_stray + n_flagged == n_points:
        return EstimationError(
            f"the rule of rows gave none of {n_stray} stripe points to a sheet: it compares them "
            "with the rows of earlier exposures of one laser alone",
            where="--method thesis",
            remedy=RULE_OF_ROWS_REMEDY,
        )
    counts = ", ".join(
        f"{count} {status.label}"
        for status in PointStatus
        if (count := sum(image.count(status) for image in images))
    )
    return EstimationError(
        f"none of {n_points} stripe points could be measured: {counts}",
        remedy=NOTHING_MEASURED_REMEDY,
    )


def summarised(warnings: Sequence[str]) -> tuple[str, ...]:
    """Of warnings of single exposures, how many there are and what the first says."""
    return (f"{len(warnings)} exposures: {warnings[0]}",) if warnings else ()


@dataclass(slots=True)
class SheetDepths:
    """Depths of the points measured with one sheet, counted as they come.

    Parameters
    ----------
    range_mm
        In which the sheet was calibrated.
    n, n_beyond
        Points, and those outside the range.
    most_beyond_mm
        How far the furthest of them lies outside.
    """

    range_mm: tuple[float, float]
    n: int = 0
    n_beyond: int = 0
    most_beyond_mm: float = 0.0

    @staticmethod
    def of(sensor: SensorCalibration) -> tuple[SheetDepths, ...]:
        """One a sheet of the sensor, without points."""
        return tuple(SheetDepths(sheet.depth_range_mm) for sheet in sensor.sheets)

    @staticmethod
    def add(counted: Sequence[SheetDepths], sheet: IntArray, depths_mm: FloatArray) -> None:
        """Count points (N,) by the index of their sheet and their Z in Sensor."""
        low, high = np.array([one.range_mm for one in counted]).T
        beyond = np.maximum(low[sheet] - depths_mm, depths_mm - high[sheet])
        for one, n in zip(
            counted, np.bincount(sheet, minlength=len(counted)).tolist(), strict=True
        ):
            one.n += n
        outside = np.flatnonzero(beyond > 0.0)
        for k in np.unique(sheet[outside]).tolist():
            own = beyond[outside[sheet[outside] == k]]
            counted[k].n_beyond += len(own)
            counted[k].most_beyond_mm = max(counted[k].most_beyond_mm, float(own.max()))


def measurement_warnings(
    images: Sequence[StripeCounts],
    depths: Sequence[SheetDepths],
    sensor: SensorCalibration,
) -> tuple[str, ...]:
    """Say what a person should know of these images; the same for still images and for scans.

    Parameters
    ----------
    images
        What each gave.
    depths
        One a sheet: of the points measured with it.
    sensor
        Camera and sheets.
    """
    warnings = []
    n_measured = [one.count(PointStatus.MEASURED) + one.count(PointStatus.SHARED) for one in images]
    both = list(zip(images, n_measured, strict=True))
    empty = [image.source for image, n in both if n == 0]
    if empty:
        warnings.append(f"{len(empty)} images gave no point: {', '.join(empty[:LISTED])}")
    doubtful = [image.source for image, n in both if 0 < n < CLEAN_SHARE * len(image)]
    if doubtful:
        other = " (another --laser-colour may show more of it)"
        warnings.append(
            f"less than half of what looked like a stripe could be measured in "
            f"{', '.join(doubtful[:LISTED])}: see in the pictures whether it is a laser line"
            f"{other if sensor.laser_colour != 'auto' else ''}"
        )
    assumed = [image.source for image, n in both if n and image.flags & StripeFlag.NOISE_ASSUMED]
    if assumed:
        warnings.append(
            f"in {len(assumed)} images the stripe is too short to show its noise: the sigmas of "
            f"their points are assumed ({', '.join(assumed[:LISTED])})"
        )
    n_outside = sum(image.count(PointStatus.OUT_OF_DEPTH) for image in images)
    if n_outside:
        warnings.append(
            f"{n_outside} points were left out: too far outside the calibrated depths; "
            "`reconstruct --depth-margin`, in widths of these depths, takes more"
        )
    n_open = sum(image.count(PointStatus.AMBIGUOUS) for image in images)
    share = n_open / max(n_open + sum(n_measured), 1)
    if share > OPEN_SHARE:
        warnings.append(
            f"{n_open} points, {100.0 * share:.0f} % of what the stripes showed, were left out: "
            "more than one light sheet may have drawn them; light fewer lasers at once"
            f"{'' if sensor.second else ', or one at a time, or use two cameras'}"
        )
    if not sensor.has_camera_covariance:
        warnings.append(without_covariance("the points' sigmas"))
    for sheet, depth in zip(sensor.sheets, depths, strict=True):
        low, high = depth.range_mm
        if depth.n_beyond:
            warnings.append(
                f"sheet {sheet.name}: {depth.n_beyond} of {depth.n} points lie up to "
                f"{depth.most_beyond_mm:.1f} mm outside its calibrated depth range, {low:.1f} to "
                f"{high:.1f} mm: their sigma supposes that the sheet goes on as it was calibrated"
            )
        if depth.n and not sheet.is_redundant:
            warnings.append(
                f"sheet {sheet.name} rests on two boards only: nothing but the coplanarity of two "
                "stripes checks it"
            )
    return tuple(warnings)


def laser_warnings(
    lasers: Iterable[tuple[str, ...]],
    labeller: StripeLabeller,
    sensor: SensorCalibration,
    options: MeasureOptions,
) -> tuple[str, ...]:
    """Warn of exposures that name other lasers than the calibrated ones, or than the one chosen,
    or that name none where one camera's stripe may be of a laser that has no sheet.

    Parameters
    ----------
    lasers
        Sources that were on in each exposure; empty if unknown.
    labeller, sensor, options
        With which they are measured.

    Raises
    ------
    InputError
        If the labeller leaves all exposures out.
    """
    named = Counter(lasers)
    why = {on: labeller.left_out(on) for on in named}
    if named and all(why.values()):
        raise InputError(
            f"no exposure can be measured: {next(iter(why.values()))}",
            remedy="leave --sheet out, or name the sheet of the laser that was on"
            if options.sheet
            else "give the calibration of this head; calibrate the sheets of all lasers that were "
            "on, or record with the calibrated ones alone",
        )
    warnings = [f"{named[on]} exposures were left out: {text}" for on, text in why.items() if text]
    unknown = {one for on, text in why.items() if not text for one in without_sheet(sensor, on)}
    if unknown and not options.sheet:
        names = ", ".join(sheet.name for sheet in sensor.sheets)
        warnings.append(
            f"exposures name the laser {', '.join(sorted(unknown))}, of which the calibration has "
            f"no sheet: their stripes were measured as if they were of {names}. If one of these is "
            "it under another name, `armscan reconstruct` takes that by --sheet; else the "
            "calibration is of another head"
        )
    unnamed, unseen = named[()], sensor.lasers_without_sheet
    if unnamed and unseen and not options.sheet and sensor.second is None:
        warnings.append(
            f"{unnamed} exposures do not name their lasers, and of the laser {', '.join(unseen)} "
            "the calibration has no sheet: where it was on, its points may be given to another "
            "sheet"
        )
    return tuple(warnings)
