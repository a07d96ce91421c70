# SPDX-License-Identifier: Apache-2.0
"""The page of a cloud against the model of its part, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.inspection.cad.alignment import Alignment, DatumUse, held_text
from armscan.inspection.cad.comparison import (
    DEFINITIONS,
    LEAST_SPOT_POINTS,
    RULE,
    CadComparison,
    FaceComparison,
)
from armscan.inspection.cad.part import PartModel, edges_of
from armscan.inspection.cad.search import spread_rows
from armscan.inspection.results import histogram
from armscan.models.calibration import Provenance
from armscan.records.cloud import PointCloud
from armscan.report.drawing import (
    ACCENT,
    INK,
    MUTED,
    SceneDots,
    SceneLines,
    SceneValues,
    chart_markup,
    new_figure,
    raster_markup,
    round_below,
    scene_markup,
    styled,
)
from armscan.report.page import Facts, Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, fact, only, share_text, significant

MAX_SHOWN = 30_000
MAX_EDGES = 6_000
MAX_IN_SECTION = 4_000
MOST_FACES = 12
"""Whose distributions are drawn: two pages of paper; the tables tell of all."""
BANDS = 8
"""Of colour: six within the tolerance, one beyond it on either side."""
RAMP = "cividis"
"""Dark inside, light outside: its lightness alone tells the sign, in grey print too, and its blues
and yellows stay apart for colour-blind readers."""
RAMP_ENDS = (0.0, 0.93)
LEAST_LIMIT_MM = 1e-4
LISTED = 4
DRAWN_SHARE = 0.05
"""Height of the largest deviation drawn in a section, over the part's size."""
STATEMENT = (
    "A deviation is the signed distance from a point to the closest point of the model's surface, "
    "positive outside the material. Alignment rms is of the points that the alignment used, "
    "outliers left out; deviation rms is of all points within reach, and is not the same thing. "
    "A face is judged by its mean and by every spot of it: the decision is the worst of these. "
)


def cad_quantities(found: CadComparison, part: PartModel) -> tuple[Quantity, ...]:
    """All that is told of a comparison."""
    a, overall = found.alignment, found.overall
    sigma = np.sqrt(np.maximum(np.diag(a.step_covariance), 0.0))
    beyond = found.n_given - len(found)
    seen = sum(one.decision != "not seen" for one in found.faces)
    size = " × ".join(f"{value:.4g}" for value in part.high_mm - part.low_mm)
    model = f"triangles of {part.source} in {len(part.face_names)} faces, {size} mm"
    told = [
        Quantity("part.triangles", "Model", len(part.triangles), meaning=model),
        Quantity(
            "points.n", "Points", overall.n,
            meaning=f"of {found.n_given:,} given; {beyond:,} lie farther than "
            f"{found.options.reach_mm:g} mm from the model and count nowhere",
        ),
        Quantity("points.n_given", "", found.n_given),
        Quantity(
            "points.n_beside_edge", "Beside edges", int(found.is_beside_edge.sum()),
            meaning="points beyond an edge, which may be of either face and count for none",
        ),
        Quantity("points.n_beyond_reach", "", beyond),
        Quantity("reach_mm", "", found.options.reach_mm),
        fact("Positive", "outside the material; in a bore that is towards its axis"),
        Quantity("faces.n_seen", "Faces seen", seen, meaning=f"of {len(found.faces)}"),
        Quantity("alignment.method", "Alignment", a.method, shown=ALIGNMENTS[a.method]),
        Quantity(
            "alignment.rms_mm", "Alignment rms" if math.isfinite(a.rms_mm) else "", a.rms_mm,
            unit="mm",
            meaning=f"of the {a.n_used:,} points that it used",
        ),
        Quantity("alignment.n_used", "", a.n_used),
        Quantity("alignment.cad_from_part", "", a.cad_from_part.matrix.tolist()),
        Quantity("alignment.covariance", "", a.covariance.tolist()),
        Quantity("alignment.sigma_turn_rad", "", sigma[:3].tolist()),
        Quantity("alignment.sigma_shift_mm", "", sigma[3:].tolist()),
        Quantity("alignment.centre_mm", "", a.centre_mm.tolist()),
        Quantity("alignment.sigma_rule", "", a.sigma_rule),
        Quantity("alignment.not_held", "", [one.text for one in a.free]),
        Quantity("alignment.n_other_poses", "", len(a.rivals)),
        *((Quantity("alignment.datums", "", [_datum_data(one) for one in a.datums]),)
          if a.datums else ()),
        *_overall_quantities(found),
    ]  # fmt: skip
    if a.method != "none":
        shown = (
            f"{significant(float(sigma[3:].max()), 'mm', 2)} at the middle of the points, "
            f"{significant(float(np.degrees(sigma[:3].max())), 'degrees', 2)}"
        )
        told.append(fact("Sigma of the alignment", shown, a.sigma_rule))
    if found.options.has_tolerance:
        told += _verdict_quantities(found)
    told.append(Quantity("faces.each", "", [_face_data(found, k) for k in range(len(found.faces))]))
    return tuple(told)


DISTRIBUTION = (
    "Each bar counts the points whose deviation lies in its class. Of a face those points count "
    "that are certainly its own; points beyond an edge, which may be of either face, are in the "
    "picture of all faces alone."
)
URGENCY = {"fail": 0, "undecided": 1, "pass": 2}
"""Order of rows; faces not seen come last."""
MARKS = {"fail": "! ", "undecided": "? "}
"""Before the word, so that grey print shows these rows at a glance."""
UNSIGNED = ("std_mm", "rms_mm")
ALIGNMENTS = {
    "best": "best fit of the whole cloud, found without a guess",
    "none": "none: the cloud's frame is taken for that of the part",
    "321": "3-2-1, by three datum faces",
    "features": "by fitted features, one after the other",
    "points": "by reference points, all together",
    "markers": "by markers, all together",
}


def _overall_quantities(found: CadComparison) -> list[Quantity]:
    overall = found.overall
    told = []
    for key, (label, meaning) in DEFINITIONS.items():
        name = "Deviation rms" if key == "rms_mm" else f"Deviation, {label}"
        if key != "n":
            value = float(getattr(overall, key))
            told.append(
                Quantity(
                    f"deviation.{key}",
                    name,
                    value,
                    shown=f"{_statistic(key, value)} mm",
                    meaning=meaning,
                )
            )
    told.append(
        Quantity("deviation.definitions", "", {k: text for k, (_, text) in DEFINITIONS.items()})
    )
    u = float(np.median(found.u_mm))
    told.append(
        Quantity(
            "deviation.u_median_mm", "U of a point's deviation", u, unit="mm",
            meaning="median, k = 2: the point's own and the alignment's",
        )
    )  # fmt: skip
    return told


def _verdict_quantities(found: CadComparison) -> list[Quantity]:
    counts = dict.fromkeys(("pass", "undecided", "fail", "not seen"), 0)
    for one in found.faces:
        if one.decision:
            counts[one.decision] += 1
    shares = 100.0 * np.bincount(found.decision[found.decision >= 0], minlength=3)
    shares = shares / max(int((found.decision >= 0).sum()), 1)
    text = ", ".join(f"{n} {word}" for word, n in counts.items() if n)
    return [
        Quantity("verdict", "Verdict", found.verdict, shown=found.verdict or "nothing to decide"),
        Quantity("verdict_faces", "Faces", counts, shown=text),
        Quantity("verdict_rule", "", RULE),
        Quantity(
            "points.percent_pass_undecided_fail", "Points", shares.tolist(),
            shown=", ".join(
                f"{share_text(share)} {word}"
                for share, word in zip(shares, ("pass", "undecided", "fail"), strict=True)
            ),
        ),
        Quantity("points.fraction_within_tolerance", "", share_within(found)),
    ]  # fmt: skip


def _face_data(found: CadComparison, face: int) -> dict[str, object]:
    one = found.faces[face]
    return {
        "face": one.name,
        **{key: getattr(one.statistics, key) for key in DEFINITIONS},
        "u_mean_mm": one.u_mean_mm,
        "spot_mm": one.spot_mm,
        "u_spot_mm": one.u_spot_mm,
        "spot_place_mm": one.spot_place_mm.tolist(),
        "tolerance_mm": one.tolerance_mm,
        "fraction_within_tolerance": share_within(found, face),
        "decision": one.decision,
        "is_seen_once": one.is_seen_once,
        "beyond_mm": one.beyond_mm,
        "beyond_place_mm": one.beyond_place_mm.tolist(),
    }


def _datum_data(one: DatumUse) -> dict[str, object]:
    return {
        "datum": one.name,
        "n_points": one.n_points,
        "holds": [motion.text for motion in one.held],
        "residual_mm": one.left_mm,
        "sigma_mm": one.sigma_mm,
    }


def datum_table(alignment: Alignment) -> tuple[Table, ...]:
    """A row a datum: what it holds, how far it stays off, how well it is known; none without."""
    if not alignment.datums:
        return ()
    in_order = alignment.method in ("321", "features")
    rows = []
    for one in alignment.datums:
        holds = held_text(one.held) or "nothing" if in_order else "together with the others"
        off, sigma = (_length(value, sign="") for value in (one.left_mm, one.sigma_mm))
        rows.append((one.name, f"{one.n_points:,}", holds, off, sigma))
    heads = ("datum", "points", "holds", "residual", "sigma")
    return (Table(heads, tuple(rows), "Datums of the alignment, mm", (2,)),)


def cad_warnings(found: CadComparison, errors_known: bool) -> tuple[str, ...]:
    """What a person should read first, in words."""
    texts = list(found.alignment.warnings)
    if not errors_known and math.isnan(found.options.uncertainty_mm):
        texts.append(
            "the cloud carries no standard deviations, so no deviation's U is known and nothing "
            "can be decided; state U with --uncertainty-mm"
        )
    beyond = 1.0 - len(found) / max(found.n_given, 1)
    if beyond > 0.1:
        texts.append(
            f"{100.0 * beyond:.0f} % of the points lie farther than {found.options.reach_mm:g} mm "
            "from the model and count nowhere; see whether they are of the part"
        )
    texts += _about_beyond(found)
    unseen = [one for one in found.faces if one.decision == "not seen"]
    for what, names in (
        ("without any point, so not judged", [one.name for one in unseen if not one.statistics.n]),
        (f"with fewer than {LEAST_SPOT_POINTS} points in every spot, so not judged",
         [f"{one.name} ({one.statistics.n:,} in all)" for one in unseen if one.statistics.n]),
    ):  # fmt: skip
        if names:
            named = ", ".join(names[:6]) + (" and others" if len(names) > 6 else "")
            texts.append(f"{what}: {named}")
    once = [one.name for one in found.faces if one.is_seen_once]
    if found.is_fused:
        texts.append(
            "the cloud is fused, so a single stripe that errs cannot be told from a dent: what "
            "would fail is undecided; U of a face's mean lacks how far exposures disagree and may "
            "be too small"
            + (f" ({', '.join(once)})" if once else "")
            + "; inspect the cloud from before it was fused"
        )
    elif once:
        texts.append(
            f"undecided because no two exposures show the deviation: {', '.join(once)}; scan there "
            "again, or look at that stripe: along an edge or a shadow it may err by tenths of a mm"
        )
    return tuple(texts)


def _about_beyond(found: CadComparison) -> list[str]:
    """Names faces beside which points lie that may be of the part, but beyond the reach."""
    off = sorted(
        (one for one in found.faces if math.isfinite(one.beyond_mm)),
        key=lambda one: -abs(one.beyond_mm),
    )
    if not off:
        return []
    told = []
    for one in off[:LISTED]:
        x, y, z = one.beyond_place_mm
        told.append(f"{one.name} ({one.beyond_mm:+.2f} mm at {x:.1f}, {y:.1f}, {z:.1f})")
    more = f" and {len(off) - LISTED} more" if len(off) > LISTED else ""
    lead = "undecided at best, because" if found.options.has_tolerance else "left out:"
    return [
        f"{lead} points lie farther than {found.options.reach_mm:g} mm off faces, where a dent or "
        f"a boss would: {', '.join(told)}{more}; look there; give a larger --reach-mm if it is of "
        "the part, cut it away with --region if it is a fixture or a reflection"
    ]


def verdict_table(found: CadComparison) -> Table:
    """A row a face, failing ones first: decision, tolerance, mean and worst spot, with U."""
    has_limit = found.options.has_tolerance
    decided = ("decision", "tolerance", "points within") if has_limit else ()
    heads = ("face", *decided, "points", "mean", "U of mean", "spot", "U of spot")
    rows = []
    for k, one in _urgent(found):
        pairs = ((one.statistics.mean_mm, one.u_mean_mm), (one.spot_mm, one.u_spot_mm))
        cells = [text for value, u in pairs for text in (_length(value), _length(u, sign=""))]
        word = MARKS.get(one.decision, "") + one.decision
        share = share_within(found, k)
        within = share_text(100.0 * share) if math.isfinite(share) else "-"
        limit = (word, _length(one.tolerance_mm, sign=""), within) if has_limit else ()
        rows.append((one.name, *limit, f"{one.statistics.n:,}", *cells))
    title = "Decision by face, mm" if has_limit else "Faces, mm"
    return Table(heads, tuple(rows), title, (1,) if has_limit else ())


def statistics_table(found: CadComparison) -> Table:
    """A row a face, and one for all points: every statistic of `DEFINITIONS`."""
    each = (("all points", found.overall), *((one.name, one.statistics) for one in found.faces))
    rows = []
    for name, statistics in each:
        cells = [_statistic(key, getattr(statistics, key)) for key in DEFINITIONS]
        rows.append((name, *cells))
    heads = ("face", *(label for label, _ in DEFINITIONS.values()))
    return Table(heads, tuple(rows), "Statistics of the deviations, mm")


def _statistic(key: str, value: float) -> str:
    if key == "n":
        return f"{value:,}"
    return _length(value, sign="" if key in UNSIGNED else "+")


def _length(value: float, *, sign: str = "+") -> str:
    """A length to a tenth of a micrometre, with its sign; a dash for none."""
    return f"{value:{sign}.4f}" if math.isfinite(value) else "-"


def cad_page(
    found: CadComparison,
    part: PartModel,
    cloud: PointCloud,
    provenance: Provenance,
    warnings: Sequence[str] = (),
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the page."""
    told = cad_quantities(found, part)
    limit = colour_limit_mm(found)
    definitions = tuple((label, meaning) for label, meaning in DEFINITIONS.values())
    is_judged = found.options.has_tolerance
    rule = f"A deviation is {RULE}." if is_judged else "No tolerance was given."
    width = significant(found.spot_width_mm, "mm", 2)
    spot = (
        ("spot", "median deviation of the spot that decides, of those of the worst decision the "
         f"one that deviates most; of all spots {width} wide with ten points or more"),
        ("U", "expanded uncertainty, k = 2: of the points, what exposures have in common, and the "
         "alignment; of a face's mean how far exposures disagree, where that is more"),
    )  # fmt: skip
    return page_of(
        provenance,
        "Part against its model",
        f"{len(found):,} points against {part.source}",
        (
            Section("Deviations in space", (Legend(_band_legend(found, limit)), Gallery(
                (deviation_scene(found, part, cloud, limit),), 560))),
            Section("Face by face", (
                Text(STATEMENT + rule), verdict_table(found), statistics_table(found))),
            Section("Distribution", (Text(DISTRIBUTION), Gallery((deviation_chart(found),)))),
            Section("Distribution by face", _face_blocks(found)),
            Section("Sections", (Text(_section_text(found, limit, part)), Gallery(
                tuple(section_chart(found, part, axis, limit) for axis in range(3))))),
            Section("What the numbers mean", (
                Table(("statistic", "definition"), (*definitions, *spot), "", (1,)),)),
            Section("Alignment", (
                Facts(_alignment_facts(found, told)), *datum_table(found.alignment))),
        ),
        cards=_cards(told),
        warnings=warnings,
        is_simulated=is_simulated,
    )  # fmt: skip


def _cards(told: Sequence[Quantity]) -> tuple[Quantity, ...]:
    keys = ("verdict", "deviation.rms_mm", "deviation.mean_mm", "alignment.rms_mm", "points.n")
    return tuple(one for one in only(told, *keys) if one.label)


def _alignment_facts(found: CadComparison, told: Sequence[Quantity]) -> tuple[Quantity, ...]:
    matrix = found.alignment.cad_from_part.matrix
    rows = "\n".join("  ".join(f"{value:12.7f}" for value in row) for row in matrix[:3])
    held = ", ".join(one.text for one in found.alignment.free) or "all motions are held"
    return (
        *(one for one in only(told, "alignment.method", "alignment.rms_mm") if one.label),
        *(item for item in told if item.label == "Sigma of the alignment"),
        fact("Not held", held),
        fact("Cad from the cloud's frame", rows, "rotation, and translation in mm"),
    )


def colour_limit_mm(found: CadComparison) -> float:
    """Deviation at which colours end: the tolerance most faces have, else what 98 % stay below."""
    limits = [one.tolerance_mm for one in found.faces if math.isfinite(one.tolerance_mm)]
    if limits:
        return float(np.median(limits))
    return max(float(np.percentile(np.abs(found.deviation_mm), 98.0)), LEAST_LIMIT_MM)


def band_edges_mm(limit_mm: float) -> FloatArray:
    """(BANDS - 1,) deviations at which the colour changes."""
    return np.linspace(-limit_mm, limit_mm, BANDS - 1)


def band_colours() -> NDArray[np.uint8]:
    """(BANDS, 3) colours, inside to outside, red green blue."""
    places = np.linspace(*RAMP_ENDS, BANDS)
    return np.asarray(colormaps[RAMP](places, bytes=True), dtype=np.uint8)[:, :3]


def _band_legend(found: CadComparison, limit: float) -> tuple[tuple[str, str], ...]:
    edges = band_edges_mm(limit)
    band = np.searchsorted(edges, found.deviation_mm)
    shares = 100.0 * np.bincount(band, minlength=BANDS) / max(len(found), 1)
    # a legend is read from the outside in, as the part is seen
    texts = [f"below {edges[0]:+.4f} mm"]
    texts += [f"{a:+.4f} to {b:+.4f} mm" for a, b in pairwise(edges)]
    texts.append(f"above {edges[-1]:+.4f} mm")
    colours = [to_hex(colour / 255.0) for colour in band_colours().astype(np.float64)]
    rows = [
        (colour, f"{text} ({share:.1f} %)")
        for colour, text, share in zip(colours, texts, shares, strict=True)
    ]
    return tuple(rows[::-1])


def deviation_scene(
    found: CadComparison, part: PartModel, cloud: PointCloud, limit_mm: float
) -> Picture:
    """The points in space over the model's edges, coloured by deviation; a click tells a point."""
    rows = spread_rows(found.points_mm, MAX_SHOWN)
    band = np.searchsorted(band_edges_mm(limit_mm), found.deviation_mm[rows])
    dots = SceneDots(found.points_mm[rows], band_colours()[band])
    source = found.rows[rows]
    values = SceneValues(
        {
            "deviation, mm": found.deviation_mm[rows],
            "U, mm": found.u_mm[rows],
            "sigma, mm": cloud.select(source).sigma_mm,
        },
        {
            "face": (found.face[rows], part.face_names),
            "exposure": (cloud.exposure[source], cloud.exposure_sources),
            "sheet": (cloud.sheet[source], cloud.sheet_names),
        },
    )
    lines = SceneLines(model_edges(part), MUTED)
    title = "Points coloured by deviation, over the model's edges"
    scene = scene_markup([dots], [lines], [], title, is_z_up=True, values=values)
    thinned = (
        f" {len(rows):,} of the {len(found):,} points are shown, spread evenly; all of them count."
        if len(rows) < len(found)
        else ""
    )
    return Picture(
        scene,
        title="Cad frame",
        caption=f"Dark is inside the material or too low, light is outside or too high.{thinned}",
    )


def model_edges(part: PartModel) -> FloatArray:
    """(2 L, 3) ends of the edges between faces, thinned where they are very many."""
    edges, number = edges_of(part.triangles)
    low = np.full(len(edges), np.iinfo(np.int64).max)
    high = np.full(len(edges), -1)
    face = np.repeat(part.face, 3)
    np.minimum.at(low, number.ravel(), face)
    np.maximum.at(high, number.ravel(), face)
    is_single = np.bincount(number.ravel(), minlength=len(edges)) == 1
    shown = np.flatnonzero((low != high) | is_single)
    shown = shown[:: max(1, math.ceil(len(shown) / MAX_EDGES))]
    return np.asarray(part.vertices_mm[edges[shown]].reshape(-1, 3))


def deviation_chart(found: CadComparison) -> Picture:
    """Histogram of the deviations with the tolerance, if all faces have one."""
    d = found.deviation_mm
    limits = [one.tolerance_mm for one in found.faces if math.isfinite(one.tolerance_mm)]
    return _histogram(
        d,
        sorted(set(limits)),
        "all faces",
        share=share_within(found),
        size=(7.0, 3.4),
        caption=f"{len(d):,} points within {found.options.reach_mm:g} mm of the model.",
    )


def face_charts(found: CadComparison) -> tuple[Picture, ...]:
    """Histograms of faces: those that did not pass, then by points; those not judged last."""
    seen = [item for item in _urgent(found) if item[1].statistics.n]
    seen.sort(key=lambda item: (URGENCY.get(item[1].decision, len(URGENCY)), -item[1].statistics.n))
    charts = []
    for k, one in seen[:MOST_FACES]:
        rows = np.flatnonzero((found.face == k) & ~found.is_beside_edge)
        d, limit = found.deviation_mm[rows], one.tolerance_mm
        has_limit = math.isfinite(limit)
        word = f", {one.decision}" if found.options.has_tolerance else ""
        caption = f"mean {_length(one.statistics.mean_mm)} mm, {len(d):,} points{word}."
        charts.append(
            _histogram(
                d, [limit] if has_limit else [], one.name, share=share_within(found, k),
                size=(4.2, 2.6), caption=caption,
            )
        )  # fmt: skip
    return tuple(charts)


def _face_blocks(found: CadComparison) -> tuple[Gallery | Text, ...]:
    n = sum(one.statistics.n > 0 for one in found.faces)
    shown = Gallery(face_charts(found), 320)
    if n <= MOST_FACES:
        return (shown,)
    text = (
        f"{MOST_FACES} of the {n} faces with points: those that did not pass, then those of most "
        "points; those that were not judged come last."
    )
    return (Text(text), shown)


STRAYS = 2.5
"""So many points far off do not widen a picture in which the others would be one bar."""


def _histogram(
    d: FloatArray,
    limits: Sequence[float],
    name: str,
    *,
    share: float,
    size: tuple[float, float],
    caption: str,
) -> Picture:
    """Numbers of points by deviation, as the thesis's figures 5.12, 5.14, 5.28 and 5.41."""
    outside = min(max(0.005, STRAYS / len(d)), 0.05)
    far = 1.15 * float(np.quantile(np.abs(d), 1.0 - outside))
    reach = max(far, *(1.3 * t for t in limits), 1e-3)
    counted = histogram(d, reach)
    with styled():
        figure = new_figure(*size)
        axes = figure.add_subplot()
        axes.stairs(counted.counts, counted.edges_mm, fill=True, color=ACCENT)
        axes.axvline(0.0, color=INK, linewidth=0.7)
        for limit in limits:
            for edge in (-limit, limit):
                axes.axvline(edge, color=INK, linewidth=0.9, linestyle="--")
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("deviation from the model, mm")
        axes.set_ylabel("points")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        axes.grid(axis="y")
        if math.isfinite(share):
            text = f"{share_text(100.0 * share)} within the limits"
            axes.set_title(text, loc="left")
    beyond = counted.n_below + counted.n_above
    told = f" {beyond:,} lie outside the picture." if beyond else ""
    dashed = " Dashed: limits." if limits else ""
    width = float(counted.edges_mm[1] - counted.edges_mm[0])
    return Picture(
        chart_markup(figure, f"Histogram of deviations: {name}"),
        title=name,
        caption=f"{caption} Classes of {significant(width, 'mm', 2)}.{told}{dashed}",
    )


def _urgent(found: CadComparison) -> list[tuple[int, FaceComparison]]:
    """Faces with their numbers, failing ones first."""
    each = list(enumerate(found.faces))
    return sorted(each, key=lambda item: URGENCY.get(item[1].decision, len(URGENCY)))


def share_within(found: CadComparison, face: int | None = None) -> float:
    """Share of the points within their faces' tolerances; of one face of its points alone.

    NaN where a point has no tolerance, or where there is none.
    """
    limits = np.array([one.tolerance_mm for one in found.faces])[found.face]
    counted = np.ones(len(found), dtype=bool)
    if face is not None:
        counted = (found.face == face) & ~found.is_beside_edge
    if not counted.any() or not np.isfinite(limits[counted]).all():
        return math.nan
    return float(np.mean(np.abs(found.deviation_mm[counted]) <= limits[counted]))


def _magnification(found: CadComparison, limit: float, part: PartModel) -> float:
    """How much deviations are enlarged in sections: a round number."""
    largest = max(limit, float(np.percentile(np.abs(found.deviation_mm), 99.0)))
    return round_below(max(DRAWN_SHARE * part.diagonal_mm / largest, 1.0))


def _section_text(found: CadComparison, limit: float, part: PartModel) -> str:
    return (
        "Cuts through the middle of the points. Lines are the model; dots are points near the cut, "
        f"drawn where their deviation, enlarged {_magnification(found, limit, part):g} times, puts "
        "them off the model."
    )


def section_chart(found: CadComparison, part: PartModel, axis: int, limit_mm: float) -> Picture:
    """A cut across one axis of Cad."""
    name = "XYZ"[axis]
    low, high = found.closest_mm[:, axis].min(), found.closest_mm[:, axis].max()
    # a little off the middle: a cut in the plane of a face shows the face, not the part
    at = float(low + 0.4837 * (high - low))
    others = [k for k in range(3) if k != axis]
    near = np.flatnonzero(np.abs(found.closest_mm[:, axis] - at) < 0.01 * part.diagonal_mm)
    near = near[:: max(1, math.ceil(len(near) / MAX_IN_SECTION))]
    size = _magnification(found, limit_mm, part)
    drawn = found.closest_mm[near] + size * found.deviation_mm[near, None] * found.normals[near]
    colours = band_colours()[np.searchsorted(band_edges_mm(limit_mm), found.deviation_mm[near])]
    outline = cut_outline(part, axis, at)[:, :, others]
    with styled():
        figure = new_figure(5.6, 4.2)
        axes = figure.add_subplot()
        axes.add_collection(LineCollection(list(outline), colors=MUTED, linewidths=0.8))
        across, up = drawn[:, others].T
        axes.scatter(across, up, c=colours / 255.0, s=4, linewidths=0)
        axes.set_xlabel(f"{'XYZ'[others[0]]}, mm")
        axes.set_ylabel(f"{'XYZ'[others[1]]}, mm")
        axes.set_aspect("equal", adjustable="datalim")
    title = f"{name} = {at:.2f} mm"
    return Picture(
        raster_markup(figure, f"Section at {title}"),
        title=title,
        caption=f"{len(near):,} points within {significant(0.01 * part.diagonal_mm, 'mm', 2)}.",
    )


def cut_outline(part: PartModel, axis: int, at_mm: float) -> FloatArray:
    """(L, 2, 3) pieces of line where a plane across an axis cuts the model's triangles."""
    corners = part.corners_mm
    height = corners[:, :, axis] - at_mm
    crossed = (height.min(axis=1) < 0.0) & (height.max(axis=1) >= 0.0)
    corners, height = corners[crossed], height[crossed]
    after, height_after = np.roll(corners, -1, axis=1), np.roll(height, -1, axis=1)
    meets = (height < 0.0) != (height_after < 0.0)
    share = height / np.where(meets, height - height_after, 1.0)
    places = corners + share[:, :, None] * (after - corners)
    return np.asarray(places[meets].reshape(-1, 2, 3))
