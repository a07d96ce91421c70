# SPDX-License-Identifier: Apache-2.0
"""What photographs show by themselves: ring markers, measured or only found, and laser stripes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import EstimationError, InputError, OptionError, listed
from armscan.geometry.arrays import FloatArray
from armscan.jobs.job import Job
from armscan.markers.candidates import RingMatchOptions
from armscan.markers.stereo_matching import StereoMatches, match_rings
from armscan.models.calibration import LaserColour
from armscan.models.two_views import StereoCalibration, TwoViews
from armscan.pipeline.instants import check_partner, pair_sources
from armscan.pipeline.progress import Progress, ProgressEvent
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.report.markers import (
    detection_page,
    marker_page,
    marker_quantities,
    ring_quantities,
    status_table,
)
from armscan.report.photographs import (
    MAX_PICTURES,
    evenly_chosen,
    stripe_page,
    stripe_quantities,
    stripe_table,
)
from armscan.report.quantity import Quantity, Summary, Table
from armscan.storage.documents import read_stereo_calibration
from armscan.storage.image_paths import are_simulated, expand_paths
from armscan.storage.images import ImageOptions, read_exposure, read_exposures, source_names
from armscan.storage.points import markers_csv, stripes_csv
from armscan.thesis.two_cameras import DecodedLine, find_coded_lines, parse_code
from armscan.vision.rings import RingDetection, RingOptions, detect_rings, perimeter_limits
from armscan.vision.stripe.extract import extract_stripes, load_stripe_method
from armscan.vision.stripe.flags import colour_contrast, least_contrast
from armscan.vision.stripe.image import (
    COLOURS,
    StripeOptions,
    colour_excess,
    find_laser_colour,
    line_strengths,
    split_channels,
)

FEW_MARKERS = 4
LARGE_MISCLOSURE = 2.0
"""Root mean square of epipolar distances over their sigma from which the calibration is doubted."""


def find_stripes(
    job: Job,
    images: Sequence[str],
    background: Sequence[str] | None = None,
    *,
    stripes: StripeOptions | None = None,
    image_options: ImageOptions | None = None,
) -> Summary:
    """Find the laser lines in images, without any calibration.

    Colour images are all looked at in the colour of the strongest lines of a sample of them, or
    in its difference from the other colours where that shows more of the sample's lines.

    ``job``: where to write the table ``NAME.csv``, with a page beside it; ``stripes.csv`` in the
    current folder if nowhere. ``background``: the same views without laser, one for each image or
    one for all; None for none.
    """
    stripes, image_options = stripes or StripeOptions(), image_options or ImageOptions()
    job = job if job.output else replace(job, output=Path("stripes.csv"))
    places = job.places(".csv", beside=(".html",))
    paths = expand_paths(images)
    names = source_names(paths)
    dark = _partners(paths, background)
    load_stripe_method(stripes.method)
    if stripes.laser_colour == "auto":
        colours = _laser_colours(paths, image_options)
        colour: LaserColour = colours[0] if colours else "auto"
        if colour in COLOURS and not background:
            colour = _clearest(colours, paths, stripes, image_options)
        stripes = replace(stripes, laser_colour=colour)
    shown = set(evenly_chosen(names, MAX_PICTURES))
    exposures: dict[str, Exposure] = {}
    profiles: list[Profile] = []
    has_colours = False
    for k, (path, name) in enumerate(zip(paths, names, strict=True)):
        exposure = read_exposure(path, image_options, source=name)
        has_colours |= not exposure.is_colourless
        partner = dark[k]
        without = None
        if partner is not None:
            without = read_exposure(partner, image_options, source=str(partner))
            check_partner(exposure, without)
        profiles.append(extract_stripes(exposure, stripes, without))
        if name in shown:
            exposures[name] = exposure
        job.progress(ProgressEvent("stripes", k + 1, len(paths), name))
    warnings = _without_line(profiles, has_colours=has_colours)
    used = (*paths, *dict.fromkeys(path for path in dark if path is not None))
    provenance = job.provenance(used, (stripes, image_options), warnings=warnings)
    is_simulated = are_simulated(paths)
    page = stripe_page(profiles, exposures, warnings, provenance, is_simulated=is_simulated)
    table = stripes_csv(profiles, is_simulated=is_simulated)
    return Summary(
        title="Laser stripes in simulated images." if is_simulated else "Laser stripes.",
        quantities=(
            *stripe_quantities(profiles),
            *_colour_taken(stripes.laser_colour, has_colours=has_colours),
        ),
        tables=(stripe_table(profiles),) if len(profiles) <= LISTED else (),
        warnings=warnings,
        written=job.write({places[0]: table, places[1]: page}),
        next_step=f"open {places[1]}; `armscan calibrate laser -h` makes points of such stripes",
        extra={"kind": "stripes", "simulated": is_simulated},
    )


def _colour_taken(colour: LaserColour, *, has_colours: bool) -> tuple[Quantity, ...]:
    if not has_colours:
        return ()
    return (Quantity("laser_colour", "Laser colour", colour, meaning="of colour images"),)


def _partners(paths: Sequence[Path], background: Sequence[str] | None) -> Sequence[Path | None]:
    """The view without laser of each image: of the same name, in order, or one for all of them."""
    if not background:
        return [None] * len(paths)
    dark = expand_paths(background)
    if len(dark) == 1:
        dark = dark * len(paths)
    chosen = pair_sources([str(path) for path in paths], [str(path) for path in dark])
    partners = [dark[k] for k in chosen]
    for lit, without in zip(paths, partners, strict=True):
        if lit.resolve() == without.resolve():
            raise InputError("this image is given as its own view without laser", where=str(lit))
    return partners


VOTERS = 12
"""Images that are asked for the laser's colour."""
JUDGES = 4
"""Images that are asked which difference from it shows more."""
LONG = 40
"""Points of a segment that is hardly an edge or a blot; in whose number channels are compared."""
MUCH_MORE, TOO_MUCH = 1.2, 3.0
"""Of what the colour itself shows, which is less noisy than a difference; beyond, and beyond a line
across each image, it is coloured print that the difference shows."""
KEPT, NEAR_PX = 0.8, 2.0
"""Share of the colour's own points that have one of the difference's beside them."""
RIVAL = 1.0 / 3.0
"""Least height of another colour's lines, of that of the strongest, to be the laser's."""
BESIDE_PX, REACH_PX = 0.5, 6.0
"""Where a colour's lines lie this far from the light's, most of them to one side, they are its glow
on that side, or the camera's colours lie beside its light."""


def _laser_colours(paths: Sequence[Path], options: ImageOptions) -> Sequence[LaserColour]:
    """The colour of the strongest lines of a sample of images, then others that may be the laser's.

    Squared heights are summed: images without the laser, of weak lines, hardly count. None if no
    image has colours, ``auto`` if none has that colour.
    """
    found: set[LaserColour] = set()
    total = np.zeros(len(COLOURS))
    for path in evenly_chosen(paths, VOTERS):
        exposure = read_exposure(path, options)
        if not exposure.is_colourless:
            channels = split_channels(exposure, None)
            found.add(find_laser_colour(channels))
            total += np.square(line_strengths(channels))
    ranked = [k for k in np.argsort(-total, kind="stable") if total[k] >= RIVAL**2 * total.max()]
    if COLOURS[ranked[0]] in found:
        return tuple(COLOURS[k] for k in ranked)
    return ("auto",) if found else ()


def _clearest(
    colours: Sequence[LaserColour],
    paths: Sequence[Path],
    stripes: StripeOptions,
    options: ImageOptions,
) -> LaserColour:
    """The first colour, or that of its differences which shows much more of the same long lines.

    Light of the room is alike in all colours: on what is white or grey a difference hides it. Where
    the first colour shows hardly a line, of blots and edges that have it, another one may.
    """
    judges = [read_exposure(path, options) for path in evenly_chosen(paths, JUDGES)]
    judges = [exposure for exposure in judges if not exposure.is_colourless]
    first, *rivals = colours
    shown = _shown_by(first, judges, stripes)
    clearest = _of_family(first, shown, judges)
    if shown[first].n_long >= LONG * len(judges):
        return _where_light_is(first, shown[clearest], judges, stripes) or clearest
    for rival in rivals:
        own = _shown_in(rival, judges, stripes)
        if own.n_long > TOO_MUCH * shown[clearest].n_long and own.n_good > own.n_flagged:
            shown, clearest = {**shown, rival: own}, rival
    if clearest not in rivals:
        return clearest
    return _of_family(clearest, _shown_by(clearest, judges, stripes), judges)


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """What a channel shows of some images: accepted points of long lines (N, 2) of each, how many
    points are accepted and flagged in all, and how many more on long lines have no colour.
    """

    long_px: Sequence[FloatArray]
    n_good: int
    n_flagged: int
    n_plain: int

    @property
    def n_long(self) -> int:
        return sum(map(len, self.long_px))


def _shown_in(
    channel: LaserColour,
    judges: Sequence[Exposure],
    stripes: StripeOptions,
    colour: LaserColour | None = None,
) -> _Shown:
    """What a channel shows; of a colour itself, or of a ``colour`` that is given, its lines."""
    colour = channel if channel in COLOURS else colour
    chosen = replace(stripes, laser_colour=channel)
    profiles = [extract_stripes(exposure, chosen) for exposure in judges]
    n_good = sum(int(profile.is_accepted.sum()) for profile in profiles)
    n_all = sum(len(profile) for profile in profiles)
    lines = [_long_lines(profile) for profile in profiles]
    n_long = sum(map(len, lines))
    if colour is not None:
        lines = _coloured(lines, colour, judges)
    n_plain = n_long - sum(map(len, lines))
    return _Shown([line.points_px for line in lines], n_good, n_all - n_good, n_plain)


def _coloured(
    lines: Sequence[Profile], colour: LaserColour, judges: Sequence[Exposure]
) -> list[Profile]:
    """Lines of each image without what hardly has the laser's colour, beside all the images' lines.

    An image without the laser shows edges of metal, which have a lens's and a sensor's fringes.
    """
    contrasts = []
    for line, exposure in zip(lines, judges, strict=True):
        gate = colour_excess(split_channels(exposure, None), colour)
        at = exposure.window.to_image(line.points_px)
        sigma = float(np.median(line.width_px)) / exposure.window.binning if len(line) else 1.0
        contrasts.append(colour_contrast(gate, np.hstack([at, line.normals_px]), sigma))
    least = least_contrast(np.concatenate(contrasts))
    return [line.select(own > least) for line, own in zip(lines, contrasts, strict=True)]


def _shown_by(
    colour: LaserColour, judges: Sequence[Exposure], stripes: StripeOptions
) -> dict[LaserColour, _Shown]:
    """What a colour shows, and each of its differences."""
    family = [one for one in get_args(LaserColour) if one.partition("-")[0] == colour]
    return {channel: _shown_in(channel, judges, stripes) for channel in family}


def _of_family(
    colour: LaserColour, shown: Mapping[LaserColour, _Shown], judges: Sequence[Exposure]
) -> LaserColour:
    """The colour itself, or its difference of most points where that shows much more of its lines,
    and what the colour shows, too. What the colour shows without having it counts against it.
    """
    own = shown[colour]
    across = sum(max(exposure.width_px, exposure.height_px) for exposure in judges)
    most = max(TOO_MUCH * own.n_long, across)
    better = [
        channel
        for channel, other in shown.items()
        if channel != colour
        and MUCH_MORE * (own.n_long - own.n_plain) < other.n_long <= most
        and _n_near(own, other) >= KEPT * own.n_long
    ]
    return max(better, key=lambda channel: shown[channel].n_long, default=colour)


def _where_light_is(
    colour: LaserColour, taken: _Shown, judges: Sequence[Exposure], stripes: StripeOptions
) -> LaserColour | None:
    """Grey, if what is taken for a colour's lines lies beside the light itself.

    Webcams and video hold colours more coarsely than light, and some of them a pixel or two beside
    it; and where a core is white, a difference shows its halo, on the side where that is brighter.
    """
    light = _shown_in("grey", judges, stripes, colour)
    shift = _shift_of(taken, light)
    # prints and things in the room's light show in grey, too
    is_same = light.n_long >= KEPT * max(taken.n_long, light.n_long + light.n_plain)
    return "grey" if is_same and shift > BESIDE_PX else None


def _shift_of(own: _Shown, light: _Shown) -> float:
    """By how many px points of a channel lie beside the light's nearest, most to the same side."""
    shifts = [np.zeros((0, 2))]
    for ours, theirs in zip(own.long_px, light.long_px, strict=True):
        if len(ours) and len(theirs):
            distance, nearest = cKDTree(theirs).query(ours)
            is_near = np.asarray(distance) < REACH_PX
            shifts.append((ours - theirs[nearest])[is_near])
    every = np.concatenate(shifts)
    return float(np.abs(np.median(every, axis=0)).max()) if len(every) else 0.0


def _n_near(own: _Shown, other: _Shown) -> int:
    """How many of a channel's points of long lines have one of another's beside them."""
    return sum(
        int(np.count_nonzero(np.asarray(cKDTree(theirs).query(ours)[0]) < NEAR_PX))
        for ours, theirs in zip(own.long_px, other.long_px, strict=True)
        if len(ours) and len(theirs)
    )


def _long_lines(profile: Profile) -> Profile:
    """Accepted points of segments that are hardly edges or blots."""
    _, number, count = np.unique(
        profile.segment[profile.is_accepted], return_inverse=True, return_counts=True
    )
    return profile.select(profile.is_accepted).select(count[number] >= LONG)


NAMED, LISTED = 5, 40
"""Images that a warning names, and those that the terminal lists: the page has them all."""


def _without_line(profiles: Sequence[Profile], *, has_colours: bool) -> tuple[str, ...]:
    empty = [profile.source for profile in profiles if not profile.is_accepted.any()]
    if not empty:
        return ()
    said = f"no line was found in {listed(empty, NAMED)}"
    if not has_colours:
        return (said,)
    return (
        f"{said}: if there is one, `armscan stripes --laser-colour` says in which colours it shows",
    )


def find_markers(
    job: Job,
    images: Sequence[str],
    *,
    rings: RingOptions | None = None,
    image_options: ImageOptions | None = None,
    codes: Sequence[str] = (),
) -> Summary:
    """Find rings in images, and lines of four among them that bear a code.

    ``job``: where to write the page; ``markers.html`` in the current folder if nowhere. ``codes``:
    codes as `parse_code` reads them; images must be free of distortion then.
    """
    rings, image_options = rings or RingOptions(), image_options or ImageOptions()
    job = job if job.output else replace(job, output=Path("markers.html"))
    places = job.places(".html", hint="; a table of markers needs `armscan markers --stereo`")
    known = tuple(parse_code(text) for text in codes)
    paths = expand_paths(images)
    exposures = read_exposures(paths, image_options)
    detections = _detect(exposures, rings, job.progress)
    warnings = tuple(
        f"no ring was found in {found.rings.source}" for found in detections if not found.rings
    )
    lines = [
        (found.rings.source, line)
        for found in detections
        for line in find_coded_lines(found.rings.centres_px, found.rings.covariance_px2, known)
    ]
    if known and not lines:
        names = " or ".join(code.name for code in known)
        warnings += (f"no four rings on a line have the cross ratio of {names}",)
    provenance = job.provenance(paths, (rings, image_options), warnings=warnings)
    is_simulated = are_simulated(paths)
    page = detection_page(exposures, detections, warnings, provenance, is_simulated=is_simulated)
    return Summary(
        title="Ring markers in simulated images." if is_simulated else "Ring markers.",
        quantities=ring_quantities(detections),
        tables=(_counts(detections), *((_coded_lines(lines),) if lines else ())),
        warnings=warnings,
        written=job.write({places[0]: page}),
        next_step=f"open {places[0]}",
        extra={
            "kind": "ring markers",
            "simulated": is_simulated,
            "images": [_ring_data(found) for found in detections],
            **({"lines": [_line_data(*line) for line in lines]} if known else {}),
        },
    )


def _coded_lines(lines: Sequence[tuple[str, DecodedLine]]) -> Table:
    """Lines whose cross ratio is that of a code (eq. 4.24)."""
    rows = tuple(
        (
            source,
            line.name,
            " ".join(str(k) for k in line.points),
            "known" if line.is_direction_known else "either",
            f"{line.ratio:.4f} ± {line.sigma:.4f}",
        )
        for source, line in lines
    )
    return Table(("coded lines in", "code", "rings", "direction", "cross ratio"), rows)


def _line_data(source: str, line: DecodedLine) -> dict[str, object]:
    return {
        "source": source,
        "code": line.name,
        "rings": line.points.tolist(),
        "is_direction_known": line.is_direction_known,
        "cross_ratio": line.ratio,
        "sigma": line.sigma,
    }


def measure_markers(
    job: Job,
    images: Sequence[str],
    stereo_file: Path,
    *,
    rings: RingOptions | None = None,
    matching: RingMatchOptions | None = None,
    image_options: ImageOptions | None = None,
) -> Summary:
    """Find rings in the images of two cameras, match and triangulate them.

    ``job``: where to write the table ``NAME.csv``, with a page beside it; ``markers.csv`` in the
    current folder if nowhere. ``rings``, ``matching``: options. A known diameter and depth range
    set the limits of eq. 4.19.
    """
    rings, image_options = rings or RingOptions(), image_options or ImageOptions()
    matching = matching or RingMatchOptions()
    job = job if job.output else replace(job, output=Path("markers.csv"))
    places = job.places(".csv", beside=(".html",))
    stereo = read_stereo_calibration(stereo_file)
    paths = expand_paths(images)
    if len(paths) != 2:
        raise OptionError(
            f"{len(paths)} images are given to `armscan markers --stereo`",
            remedy="give the left one, then the right",
        )
    exposures = read_exposures(paths, image_options)
    _check_sizes(exposures, stereo)
    limited = _limited(rings, matching, stereo)
    detections = _detect(exposures, limited, job.progress)
    left, right = (found.rings for found in detections)
    views = TwoViews(stereo.left.camera, stereo.right.camera, stereo.right_from_left)
    matches = match_rings(left, right, views, stereo.covariance, matching)
    if not len(matches.left):
        counts = "; ".join(f"{n}: {status.value}" for status, n in matches.counts.items() if n)
        raise EstimationError(
            f"no marker was matched ({len(left)} rings left, {len(right)} right"
            + (f"; {counts})" if counts else ")"),
            remedy="check that the left image comes first, show four markers or more to both "
            "cameras, and state their size as in `armscan markers --diameter 6`",
        )
    warnings = _warnings(matches)
    provenance = job.provenance(
        (*paths, stereo_file),
        (rings, matching, image_options),
        parents=(stereo.provenance,),
        warnings=warnings,
    )
    is_simulated = are_simulated(paths)
    page = marker_page(
        exposures, detections, matches, warnings, provenance, is_simulated=is_simulated
    )
    table = markers_csv(matches.markers, is_simulated=is_simulated)
    return Summary(
        title="Markers measured" + (" in simulated images." if is_simulated else "."),
        quantities=marker_quantities(matches, detections),
        tables=(_counts(detections), status_table(matches)),
        warnings=warnings,
        written=job.write({places[0]: table, places[1]: page}),
        next_step="`armscan register -h` joins scans that share markers",
        extra={
            "kind": "markers",
            "simulated": is_simulated,
            "images": [_ring_data(found) for found in detections],
        },
        forced=provenance.forced,
    )


def _detect(
    exposures: Sequence[Exposure], options: RingOptions, progress: Progress
) -> list[RingDetection]:
    found = []
    for k, exposure in enumerate(exposures):
        found.append(detect_rings(exposure, options))
        progress(ProgressEvent("rings", k + 1, len(exposures), exposure.source))
    return found


def _limited(
    rings: RingOptions, matching: RingMatchOptions, stereo: StereoCalibration
) -> RingOptions:
    """Limits of eq. 4.19 from the markers' size, where it and their depth are given."""
    if matching.diameter_mm is None or matching.depth_mm is None:
        return rings
    focals = [(camera.camera.fx_px, camera.camera.fy_px) for camera in (stereo.left, stereo.right)]
    near, far = matching.depth_mm
    # The right camera may stand nearer or farther by as much as the two stand apart.
    apart = float(np.linalg.norm(stereo.right_from_left.translation_mm))
    distances = (max(near - apart, near / 2.0), far + apart)
    low, high = perimeter_limits(matching.diameter_mm, float(np.mean(focals)), distances)
    low = max(low, rings.min_perimeter_px)
    return replace(rings, min_perimeter_px=low, max_perimeter_px=high)


def _check_sizes(exposures: Sequence[Exposure], stereo: StereoCalibration) -> None:
    for exposure, calibration in zip(exposures, (stereo.left, stereo.right), strict=True):
        camera = calibration.camera
        if (exposure.width_px, exposure.height_px) != (camera.width_px, camera.height_px):
            raise InputError(
                f"the image has {exposure.width_px} x {exposure.height_px} px, its camera "
                f"{camera.width_px} x {camera.height_px} px",
                where=exposure.source,
                remedy="give full images of the calibrated cameras, the left one first",
            )


def _warnings(matches: StereoMatches) -> tuple[str, ...]:
    found = []
    if len(matches.left) < FEW_MARKERS:
        found.append(f"{len(matches.left)} markers: three are the least to join two scans by")
    scaled = float(np.sqrt(np.mean((matches.distance_px / matches.sigma_px) ** 2)))
    if scaled > LARGE_MISCLOSURE:
        found.append(
            f"epipolar distances are {scaled:.1f} times what the calibration and the centres "
            "explain: the cameras may have moved since the calibration"
        )
    return tuple(found)


def _counts(detections: Sequence[RingDetection]) -> Table:
    rows = tuple(
        (found.rings.source, str(len(found.rings)), str(len(found.reasons))) for found in detections
    )
    return Table(("image", "rings", "filtered out"), rows)


def _ring_data(found: RingDetection) -> dict[str, object]:
    rings = found.rings
    return {
        "source": rings.source,
        "rings": [
            {
                "x_px": float(rings.centres_px[k, 0]),
                "y_px": float(rings.centres_px[k, 1]),
                "covariance_px2": rings.covariance_px2[k].tolist(),
                "perimeter_px": float(rings.perimeter_px[k]),
                "roundness": float(rings.roundness[k]),
                "contrast": float(rings.contrast[k]),
            }
            for k in range(len(rings))
        ],
        "dropped": [
            {"x_px": float(x), "y_px": float(y), "reason": reason}
            for (x, y), reason in zip(found.dropped_px, found.reasons, strict=True)
        ],
    }
