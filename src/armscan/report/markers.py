# SPDX-License-Identifier: Apache-2.0
"""The page of ring markers, found in images or measured by two cameras, and their numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.markers.stereo_matching import RingStatus, StereoMatches
from armscan.models.calibration import Provenance
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.report.drawing import ALERT, Labels, Marks, photo_markup
from armscan.report.page import Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, fact, plural, significant
from armscan.vision.rings import RingDetection

FOUND, LEFT_ALONE = "#12b5dd", "#f2a33a"
"""Marks on grey photographs: rings taken, and rings that no pair was made of."""
SEGMENTS = 40
LABEL_ABOVE_PX = 4.0


def ring_quantities(detections: Sequence[RingDetection]) -> tuple[Quantity, ...]:
    """What is told of rings in images."""
    n_rings = sum(len(found.rings) for found in detections)
    n_dropped = sum(len(found.reasons) for found in detections)
    variances = [np.einsum("nii->n", found.rings.covariance_px2) / 2.0 for found in detections]
    flat = np.concatenate([*variances, np.zeros(0)])
    sigma = significant(float(np.sqrt(np.median(flat))), "px") if len(flat) else "not known"
    return (
        fact("Rings", str(n_rings), f"in {plural(len(detections), 'image')}"),
        fact("Centre sigma", sigma, "an axis, median"),
        fact("Filtered out", str(n_dropped), _reasons(detections) or "two rims, but no ring"),
    )


def marker_quantities(
    matches: StereoMatches, detections: Sequence[RingDetection]
) -> tuple[Quantity, ...]:
    """What is told of markers that two cameras saw."""
    markers = matches.markers
    n_left, n_right = (len(found.rings) for found in detections)
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    depth_um = significant(1000.0 * float(np.median(sigma[:, 2])), "µm")
    places = zip(markers.ids, markers.points_mm, sigma, strict=True)
    statuses = {status.name.lower(): matches.counts[status] for status in RingStatus}
    return (
        Quantity(
            "markers",
            "Markers",
            [
                {"id": int(number), "xyz_mm": place.tolist(), "sigma_mm": sigmas.tolist()}
                for number, place, sigmas in places
            ],
            shown=str(len(markers)),
            meaning=f"of {n_left} rings left and {n_right} right",
        ),
        Quantity("frame", "", markers.frame),
        Quantity(
            "epipolar_rms_px",
            "Epipolar distance",
            float(np.sqrt(np.mean(matches.distance_px**2))),
            unit="px",
            meaning="rms (eq. 4.26)",
        ),
        fact(
            "Depth sigma",
            depth_um,
            "median, of the centres; the calibration's share is common to all",
        ),
        Quantity(
            "n_planes",
            "Flat faces",
            matches.n_planes,
            meaning="on which six markers or more agree",
        ),
        Quantity("n_candidates", "", matches.n_candidates),
        Quantity("left_rings", "", statuses),
    )


def detection_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    warnings: Sequence[str],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of rings in images."""
    pictures = tuple(
        _picture(exposure, found, np.ones(len(found.rings), np.bool_), _numbers(found))
        for exposure, found in zip(exposures, detections, strict=True)
    )
    legend = Legend(((FOUND, "both rims and centre"), (ALERT, "two rims that a filter dropped")))
    return page_of(
        provenance,
        "Ring markers",
        plural(len(exposures), "image"),
        (
            Section("Rings in the images", (legend, Gallery(pictures, 900))),
            Section("Every ring", (_ring_table(detections),), is_folded=True),
        ),
        cards=ring_quantities(detections),
        warnings=warnings,
        is_simulated=is_simulated,
    )


def marker_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    matches: StereoMatches,
    warnings: Sequence[str],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of markers that two cameras saw."""
    pictures = []
    for exposure, found, rows in zip(
        exposures, detections, (matches.left, matches.right), strict=True
    ):
        names = [""] * len(found.rings)
        for row, number in zip(rows, matches.markers.ids, strict=True):
            names[row] = str(number)
        is_taken = np.isin(np.arange(len(found.rings)), rows)
        pictures.append(_picture(exposure, found, is_taken, names))
    legend = Legend(
        (
            (FOUND, "both rims and centre of a marker"),
            (LEFT_ALONE, "a ring without a partner"),
            (ALERT, "two rims that a filter dropped"),
        )
    )
    text = Text(
        f"{plural(matches.n_candidates, 'pair')} lay within the epipolar threshold (eq. 4.27). "
        "What stays ambiguous is not matched."
    )
    became = (status_table(matches), text)
    return page_of(
        provenance,
        "Ring markers in space",
        f"{exposures[0].source} and {exposures[1].source}",
        (
            Section("Rings in the images", (legend, Gallery(tuple(pictures), 640))),
            Section("What became of the rings of the left image", became),
            Section("Every marker", (_marker_table(matches),)),
            Section("Every ring", (_ring_table(detections),), is_folded=True),
        ),
        cards=[item for item in marker_quantities(matches, detections) if item.label],
        warnings=warnings,
        is_simulated=is_simulated,
    )


def status_table(matches: StereoMatches) -> Table:
    """What became of the rings of the left image."""
    rows = tuple((status.value, str(n)) for status, n in matches.counts.items() if n)
    return Table(("rings of the left image", "count"), rows)


def _marker_table(matches: StereoMatches) -> Table:
    """Places and sigmas of the markers."""
    markers = matches.markers
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    rows = tuple(
        (
            str(markers.ids[k]),
            *(f"{value:.4f}" for value in markers.points_mm[k]),
            *(significant(1000.0 * value) for value in sigma[k]),
            f"{matches.distance_px[k]:+.3f}",
        )
        for k in np.argsort(markers.ids)
    )
    axes = ("x mm", "y mm", "z mm", "σx µm", "σy µm", "σz µm")
    return Table(("marker", *axes, "epipolar px"), rows, "Markers, frame Sensor")


def _ring_table(detections: Sequence[RingDetection]) -> Table:
    """Size, shape and centre of each ring."""
    rows = []
    for found in detections:
        rings = found.rings
        sigma = np.sqrt(np.einsum("nii->n", rings.covariance_px2) / 2.0)
        rows += [
            (
                rings.source,
                str(k),
                f"{rings.centres_px[k, 0]:.3f}",
                f"{rings.centres_px[k, 1]:.3f}",
                f"{sigma[k]:.4f}",
                f"{rings.perimeter_px[k]:.1f}",
                f"{rings.roundness[k]:.2f}",
                f"{rings.contrast[k]:.2f}",
            )
            for k in range(len(rings))
        ]
    heads = ("image", "ring", "x px", "y px", "σ px", "perimeter px", "roundness", "contrast")
    return Table(heads, tuple(rows))


def _picture(
    exposure: Exposure, found: RingDetection, is_taken: BoolArray, names: Sequence[str]
) -> Picture:
    rings = found.rings
    marks = [
        Marks(_outlines(rings, is_taken), FOUND, "line", 1.6),
        Marks(rings.centres_px[is_taken], FOUND, "dot", 3.0),
        Marks(_outlines(rings, ~is_taken), LEFT_ALONE, "line", 1.6),
        Marks(found.dropped_px, ALERT, "ring", 14.0),
    ]
    height = rings.outer_half_px[:, 1] + LABEL_ABOVE_PX
    above = rings.centres_px - np.column_stack([np.zeros(len(rings)), height])
    caption = f"{plural(int(is_taken.sum()), 'ring')} taken"
    if (~is_taken).any():
        caption += f", {int((~is_taken).sum())} without a partner"
    if found.reasons:
        caption += f", {len(found.reasons)} filtered out ({_reasons([found])})"
    markup = photo_markup(
        exposure,
        marks,
        f"{exposure.source} with its rings",
        labels=(Labels(above, tuple(names), "white", 13.0),),
        longest_px=1600,
        is_grey=True,
    )
    return Picture(markup, caption + ".", exposure.source)


def _outlines(rings: RingImages, chosen: BoolArray) -> FloatArray:
    """Both rims of the chosen rings as line segments (M, 2), two rows a segment."""
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    along = np.stack([np.cos(rings.direction_rad), np.sin(rings.direction_rad)], axis=1)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=2)
    lines = []
    for half in (rings.outer_half_px, rings.inner_half_px):
        of_axes = half[:, ::-1, None] * circle
        points = rings.centres_px[:, None] + (axes @ of_axes).transpose(0, 2, 1)
        pairs = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        lines.append(pairs[chosen].reshape(-1, 2))
    return np.concatenate(lines)


def _numbers(found: RingDetection) -> list[str]:
    return [str(k) for k in range(len(found.rings))]


def _reasons(detections: Sequence[RingDetection]) -> str:
    counts = Counter(reason for found in detections for reason in found.reasons)
    return ", ".join(f"{n} by {reason}" for reason, n in counts.items())
