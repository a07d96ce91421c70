# SPDX-License-Identifier: Apache-2.0
"""The page of markers found or measured."""

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
from armscan.report.page import (
    Card,
    Gallery,
    Legend,
    Page,
    Picture,
    Section,
    Text,
    footer,
    origin_section,
)
from armscan.report.quantity import Table, significant
from armscan.vision.rings import RingDetection

FOUND, LEFT_ALONE = "#12b5dd", "#f2a33a"
"""Marks on grey photographs: rings taken, and rings that no pair was made of."""
_SEGMENTS = 40
_LABEL_ABOVE_PX = 4.0


def detection_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    warnings: tuple[str, ...],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of rings in images."""
    n_rings = sum(len(found.rings) for found in detections)
    n_dropped = sum(len(found.reasons) for found in detections)
    pictures = tuple(
        _picture(exposure, found, np.ones(len(found.rings), np.bool_), _numbers(found))
        for exposure, found in zip(exposures, detections, strict=True)
    )
    return Page(
        title="Ring markers",
        subtitle=_plural(len(exposures), "image"),
        cards=(
            Card("Rings", str(n_rings), f"in {_plural(len(exposures), 'image')}"),
            Card("Centre sigma", _median_sigma(detections), "an axis, median"),
            Card("Filtered out", str(n_dropped), _reasons(detections) or "two rims, but no ring"),
        ),
        warnings=warnings,
        sections=(
            Section("Rings in the images", (_legend(has_pairs=False), Gallery(pictures, 900))),
            Section("Every ring", (ring_table(detections),), is_folded=True),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def stereo_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    matches: StereoMatches,
    warnings: tuple[str, ...],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of markers that two cameras saw."""
    ids = matches.markers.ids
    pictures = []
    for exposure, found, rows in zip(
        exposures, detections, (matches.left, matches.right), strict=True
    ):
        names = [""] * len(found.rings)
        for row, number in zip(rows, ids, strict=True):
            names[row] = str(number)
        taken = np.isin(np.arange(len(found.rings)), rows)
        pictures.append(_picture(exposure, found, taken, names))
    sigma = np.sqrt(np.einsum("nii->ni", matches.markers.covariance_mm2))
    return Page(
        title="Ring markers in space",
        subtitle=f"{exposures[0].source} and {exposures[1].source}",
        cards=(
            Card(
                "Markers", str(len(ids)), f"of {len(detections[0].rings)} rings in the left image"
            ),
            Card(
                "Epipolar distance", significant(epipolar_rms_px(matches), "px"), "rms (eq. 4.26)"
            ),
            Card(
                "Depth sigma",
                significant(1000.0 * float(np.median(sigma[:, 2])), "µm"),
                "median, of the centres; the calibration's share is common to all",
            ),
            Card("Flat faces", str(matches.n_planes), "on which six markers or more agree"),
        ),
        warnings=warnings,
        sections=(
            Section(
                "Rings in the images", (_legend(has_pairs=True), Gallery(tuple(pictures), 640))
            ),
            Section(
                "What became of the rings of the left image",
                (
                    fate_table(matches),
                    Text(
                        f"{_plural(matches.n_candidates, 'pair')} lay within the epipolar "
                        "threshold (eq. 4.27). What stays ambiguous is not matched."
                    ),
                ),
            ),
            Section("Every marker", (marker_table(matches),)),
            Section("Every ring", (ring_table(detections),), is_folded=True),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def epipolar_rms_px(matches: StereoMatches) -> float:
    """Root mean square epipolar distance of the markers; NaN without any."""
    return float(np.sqrt(np.mean(matches.distance_px**2))) if len(matches.left) else float("nan")


def fate_table(matches: StereoMatches) -> Table:
    """How many rings of the left image met each fate."""
    rows = tuple((fate.value, str(n)) for fate, n in matches.counts.items() if n)
    return Table(("rings of the left image", "count"), rows)


def marker_table(matches: StereoMatches) -> Table:
    """Places and sigmas of the markers."""
    markers = matches.markers
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    order = np.argsort(markers.ids)
    rows = tuple(
        (
            str(markers.ids[k]),
            *(f"{value:.4f}" for value in markers.points_mm[k]),
            *(significant(1000.0 * value) for value in sigma[k]),
            f"{matches.distance_px[k]:+.3f}",
        )
        for k in order
    )
    axes = ("x mm", "y mm", "z mm", "σx µm", "σy µm", "σz µm")
    return Table(("marker", *axes, "epipolar px"), rows, "Markers, frame Sensor")


def ring_table(detections: Sequence[RingDetection]) -> Table:
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
    exposure: Exposure, found: RingDetection, taken: BoolArray, names: Sequence[str]
) -> Picture:
    rings = found.rings
    width = 1.6
    marks = [
        Marks(_outlines(rings, taken), FOUND, "line", width),
        Marks(rings.centres_px[taken], FOUND, "dot", 3.0),
        Marks(_outlines(rings, ~taken), LEFT_ALONE, "line", width),
        Marks(found.dropped_px, ALERT, "ring", 14.0),
    ]
    above = rings.centres_px - np.column_stack(
        [np.zeros(len(rings)), rings.outer_half_px[:, 1] + _LABEL_ABOVE_PX]
    )
    label = Labels(above, tuple(names), "white", 13.0)
    n_dropped = len(found.reasons)
    caption = f"{_plural(int(taken.sum()), 'ring')} taken"
    if (~taken).any():
        caption += f", {int((~taken).sum())} without a partner"
    if n_dropped:
        caption += f", {n_dropped} filtered out ({_reasons([found])})"
    return Picture(
        photo_markup(
            exposure,
            marks,
            f"{exposure.source} with its rings",
            labels=(label,),
            longest_px=1600,
            is_grey=True,
        ),
        caption + ".",
        exposure.source,
    )


def _outlines(rings: RingImages, chosen: BoolArray) -> FloatArray:
    """Both rims of the chosen rings as line segments (M, 2), two rows a segment."""
    angle = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    along = np.stack([np.cos(rings.direction_rad), np.sin(rings.direction_rad)], axis=1)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=2)
    lines = []
    for half in (rings.outer_half_px, rings.inner_half_px):
        own = half[:, ::-1, None] * circle
        points = rings.centres_px[:, None] + (axes @ own).transpose(0, 2, 1)
        pairs = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        lines.append(pairs[chosen].reshape(-1, 2))
    return np.concatenate(lines)


def _legend(*, has_pairs: bool) -> Legend:
    entries = [(FOUND, "both rims and centre of a marker" if has_pairs else "both rims and centre")]
    if has_pairs:
        entries.append((LEFT_ALONE, "a ring without a partner"))
    entries.append((ALERT, "two rims that a filter dropped"))
    return Legend(tuple(entries))


def _numbers(found: RingDetection) -> list[str]:
    return [str(k) for k in range(len(found.rings))]


def _median_sigma(detections: Sequence[RingDetection]) -> str:
    variances = [np.einsum("nii->n", found.rings.covariance_px2) / 2.0 for found in detections]
    flat = np.concatenate(variances) if variances else np.zeros(0)
    return significant(float(np.sqrt(np.median(flat))), "px") if len(flat) else "not known"


def _reasons(detections: Sequence[RingDetection]) -> str:
    counts = Counter(reason for found in detections for reason in found.reasons)
    return ", ".join(f"{n} by {reason}" for reason, n in counts.items())


def _plural(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def fate_counts(matches: StereoMatches) -> dict[str, int]:
    """Counts by the lower-case name of the fate, for programs."""
    return {fate.name.lower(): matches.counts[fate] for fate in RingStatus}
