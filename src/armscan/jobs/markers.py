# SPDX-License-Identifier: Apache-2.0
"""From photographs of ring markers to a table of markers, measured or only found, and the page
about them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from armscan.errors import EstimationError, InputError, OptionError
from armscan.markers.candidates import RingMatchOptions
from armscan.markers.stereo_matching import StereoMatches, match_rings
from armscan.models.two_views import StereoCalibration, TwoViews
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.report.markers import (
    detection_page,
    epipolar_rms_px,
    fate_counts,
    fate_table,
    stereo_page,
)
from armscan.report.page import render_page
from armscan.report.quantity import Summary, Table, significant
from armscan.storage.documents import new_provenance, read_stereo_calibration
from armscan.storage.files import check_outputs, write_files
from armscan.storage.image_paths import are_simulated, expand_paths
from armscan.storage.images import ImageOptions, read_exposures
from armscan.storage.points import markers_csv
from armscan.vision.rings import RingDetection, RingOptions, detect_rings, perimeter_limits

_FEW_MARKERS = 4
_LARGE_MISCLOSURE = 2.0
"""Root mean square of epipolar distances over their sigma from which the calibration is doubted."""


@dataclass(frozen=True, slots=True)
class MarkersRequest:
    """Where to look for markers, and where to write.

    Parameters
    ----------
    images
        Files, folders or patterns; with ``stereo`` the left and the right image of one instant.
    stereo
        Calibration of the two cameras; None to find rings only.
    output
        Page ``NAME.html``, or with ``stereo`` the table ``NAME.csv`` with a page beside it; None
        for ``markers`` in the current folder.
    rings, matching
        Options. With ``stereo``, a known diameter and depth range set the limits of eq. 4.19.
    image_options
        How pixels are read.
    is_overwriting
        Replace results that exist.
    command
        The command line, for the record.
    """

    images: tuple[str, ...]
    stereo: Path | None = None
    output: Path | None = None
    rings: RingOptions = field(default_factory=RingOptions)
    matching: RingMatchOptions = field(default_factory=RingMatchOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()


def run_markers(request: MarkersRequest, progress: Progress = silent) -> Summary:
    """Find rings, and with a stereo calibration match and triangulate them.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or no marker could be matched; nothing is
        written then.
    """
    return _find_rings(request, progress) if request.stereo is None else _measure(request, progress)


def _find_rings(request: MarkersRequest, progress: Progress) -> Summary:
    page_path = _output(request, ".html")
    check_outputs((page_path,), is_overwriting=request.is_overwriting)
    paths = expand_paths(request.images)
    exposures = read_exposures(paths, request.image_options)
    detections = _detect(exposures, request.rings, progress)
    warnings = tuple(
        f"no ring was found in {found.rings.source}" for found in detections if not found.rings
    )
    provenance = new_provenance(
        paths,
        command=request.command,
        options=(request.rings, request.image_options),
        warnings=warnings,
    )
    page = detection_page(
        exposures, detections, warnings, provenance, is_simulated=are_simulated(paths)
    )
    write_files({page_path: render_page(page)}, is_overwriting=request.is_overwriting)
    n_rings = sum(len(found.rings) for found in detections)
    return Summary(
        title="Ring markers in simulated images." if page.is_simulated else "Ring markers.",
        facts=(("rings", f"{n_rings} in {len(exposures)} images"),),
        tables=(_counts(detections),),
        warnings=warnings,
        written=(page_path,),
        next_step=f"open {page_path}",
        data={
            "kind": "ring markers",
            "simulated": page.is_simulated,
            "images": [_ring_data(found) for found in detections],
        },
    )


def _measure(request: MarkersRequest, progress: Progress) -> Summary:
    if request.stereo is None:
        raise OptionError("no stereo calibration is given", remedy="give --stereo stereo.json")
    table_path = _output(request, ".csv")
    page_path = table_path.with_suffix(".html")
    check_outputs((table_path, page_path), is_overwriting=request.is_overwriting)
    stereo = read_stereo_calibration(request.stereo)
    paths = expand_paths(request.images)
    if len(paths) != 2:
        raise OptionError(
            f"{len(paths)} images are given with --stereo",
            remedy="give the left one, then the right",
        )
    exposures = read_exposures(paths, request.image_options)
    _check_sizes(exposures, stereo)
    detections = _detect(exposures, _ring_options(request, stereo), progress)
    left, right = (found.rings for found in detections)
    views = TwoViews(stereo.left.camera, stereo.right.camera, stereo.right_from_left)
    matches = match_rings(left, right, views, stereo.covariance, request.matching)
    if not len(matches.left):
        raise _nothing_matched(left, right, matches)
    warnings = _warnings(matches)
    provenance = new_provenance(
        (*paths, request.stereo),
        command=request.command,
        parents=(stereo.provenance,),
        options=(request.rings, request.matching, request.image_options),
        warnings=warnings,
    )
    page = stereo_page(
        exposures, detections, matches, warnings, provenance, is_simulated=are_simulated(paths)
    )
    write_files(
        {table_path: markers_csv(matches.markers), page_path: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    summary = _measured_summary(
        matches, detections, warnings, (table_path, page_path), is_simulated=page.is_simulated
    )
    return replace(summary, forced=provenance.forced)


def _detect(
    exposures: Sequence[Exposure], options: RingOptions, progress: Progress
) -> list[RingDetection]:
    found = []
    for k, exposure in enumerate(exposures):
        found.append(detect_rings(exposure, options))
        progress(ProgressEvent("rings", k + 1, len(exposures), exposure.source))
    return found


def _ring_options(request: MarkersRequest, stereo: StereoCalibration) -> RingOptions:
    """Limits of eq. 4.19 from the markers' size, where it and their depth are given."""
    matching = request.matching
    if matching.diameter_mm is None or matching.depth_mm is None:
        return request.rings
    focals = [(camera.camera.fx_px, camera.camera.fy_px) for camera in (stereo.left, stereo.right)]
    near, far = matching.depth_mm
    # The right camera may stand nearer or farther by as much as the two stand apart.
    apart = float(np.linalg.norm(stereo.right_from_left.translation_mm))
    distances = (max(near - apart, near / 2.0), far + apart)
    limits = perimeter_limits(matching.diameter_mm, float(np.mean(focals)), distances)
    return replace(
        request.rings,
        min_perimeter_px=max(limits[0], request.rings.min_perimeter_px),
        max_perimeter_px=limits[1],
    )


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


def _nothing_matched(
    left: RingImages, right: RingImages, matches: StereoMatches
) -> EstimationError:
    fates = "; ".join(f"{n}: {fate.value}" for fate, n in matches.counts.items() if n)
    return EstimationError(
        f"no marker was matched ({len(left)} rings left, {len(right)} right"
        + (f"; {fates})" if fates else ")"),
        remedy="check that the left image comes first, show four markers or more to both cameras, "
        "and state their --diameter",
    )


def _warnings(matches: StereoMatches) -> tuple[str, ...]:
    found = []
    if len(matches.left) < _FEW_MARKERS:
        found.append(f"{len(matches.left)} markers: three are the least to join two scans by")
    scaled = float(np.sqrt(np.mean((matches.distance_px / matches.sigma_px) ** 2)))
    if scaled > _LARGE_MISCLOSURE:
        found.append(
            f"epipolar distances are {scaled:.1f} times what the calibration and the centres "
            "explain: the cameras may have moved since the calibration"
        )
    return tuple(found)


def _measured_summary(
    matches: StereoMatches,
    detections: Sequence[RingDetection],
    warnings: tuple[str, ...],
    written: tuple[Path, Path],
    *,
    is_simulated: bool,
) -> Summary:
    markers = matches.markers
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    n_left, n_right = (len(found.rings) for found in detections)
    return Summary(
        title="Markers measured" + (" in simulated images." if is_simulated else "."),
        facts=(
            ("markers", f"{len(markers)} of {n_left} rings left and {n_right} right"),
            ("epipolar distance", f"{significant(epipolar_rms_px(matches))} px rms"),
            ("depth sigma", f"{significant(1000.0 * float(np.median(sigma[:, 2])))} µm, median"),
        ),
        tables=(_counts(detections), fate_table(matches)),
        warnings=warnings,
        written=written,
        next_step="`armscan register -h` joins scans that share markers",
        data={
            "kind": "markers",
            "simulated": is_simulated,
            "frame": markers.frame,
            "markers": [
                {"id": int(number), "xyz_mm": place.tolist(), "sigma_mm": spread.tolist()}
                for number, place, spread in zip(markers.ids, markers.points_mm, sigma, strict=True)
            ],
            "epipolar_rms_px": epipolar_rms_px(matches),
            "n_candidates": matches.n_candidates,
            "n_planes": matches.n_planes,
            "left_rings": fate_counts(matches),
            "images": [_ring_data(found) for found in detections],
        },
    )


def _counts(detections: Sequence[RingDetection]) -> Table:
    return Table(
        ("image", "rings", "filtered out"),
        tuple(
            (found.rings.source, str(len(found.rings)), str(len(found.reasons)))
            for found in detections
        ),
    )


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


def _output(request: MarkersRequest, suffix: str) -> Path:
    path = Path("markers" + suffix) if request.output is None else request.output
    if path.suffix.lower() != suffix:
        raise OptionError(
            f"the output's name ends in '{path.suffix}'",
            where=f"-o {path}",
            remedy=f"end it in {suffix}"
            + ("" if request.stereo else "; a table of markers needs --stereo"),
        )
    return path
