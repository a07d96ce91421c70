# SPDX-License-Identifier: Apache-2.0
"""The demos of the twin's heads: figures for programs and beside the thesis, and their pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from armscan.geometry.arrays import BoolArray
from armscan.inspection.results import Deviations, PointCounts, StepInspection
from armscan.pipeline.scan import ScanReconstruction
from armscan.pipeline.truth import HeadDemo, NamingErrors
from armscan.reconstruction.labels import PointStatus
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.report.charts import deviation_view
from armscan.report.cloud import cloud_view
from armscan.report.drawing import Marks, photo_markup, scene_markup, uniform_dots
from armscan.report.hand_eye import hand_eye_quantities, total_covariance
from armscan.report.inspection.shapes import (
    deviation_histogram,
    height_histogram,
)
from armscan.report.page import Facts, Gallery, Page, Picture, Section, Text
from armscan.report.photographs import sheet_colour
from armscan.report.quantity import Quantity, Table, fact, for_people, share_text, significant

Figures = Mapping[str, Any]
"""What `head_data` gives of one head."""

KINDS = {
    "thesis-single": "single-line",
    "thesis-cross": "cross-line",
    "thesis-multi": "multi-line",
}
"""Words for the heads that have a demo."""

FRACTION_RULE = (
    "rms and shares count every measured point of the feature (up to 1 mm from it), those that its "
    "fit left out included; points further away are counted beside them: they lie on what stands "
    "around, or are wrong"
)
FRAMES_A_SECOND = 80
"""Of the thesis's cameras (5.3.1)."""
MAX_SHOWN = 12_000
"""Points that a picture in space holds."""

THESIS: Mapping[str, Mapping[str, str]] = {
    "points an exposure": {
        "thesis-single": "968",
        "thesis-cross": "1171",
        "thesis-multi": "3859 (five lines)",
    },
    "plate within 0.05 mm": {
        "thesis-single": "97.9 % of 83,210 points",
        "thesis-cross": "96 %",
    },
    "plate within 0.08 mm": {"thesis-multi": "95.1 % (five lines)"},
    "ball of 34.96 mm: diameter": {"thesis-single": "34.94 mm, 0.02 mm off"},
    "ball within 0.05 mm": {"thesis-single": "95.54 % of 179,427 points"},
    "step, one exposure at rest": {
        "thesis-single": "20 mm: 19.989 mm, 0.006 mm (its cross-line head)",
        "thesis-cross": "20 mm: 19.989 mm, 0.006 mm",
        "thesis-multi": "5 mm: 5.002 mm, 0.02 mm (five lines)",
    },
    "hand-eye, rotation": {"thesis-single": "0.053°, 0.048°, 0.024° (spread of five)"},
    "hand-eye, translation": {"thesis-single": "0.068, 0.027, 0.060 mm (spread of five)"},
}
"""What the thesis printed of its heads, measured on real instruments: sections 5.1.3, 5.1.4, 5.2.2,
5.2.4, 5.3.3, 5.3.5 and figure 5.42."""

SCENE_TEXTS = {
    "camera": "the circle grid, to calibrate the camera or cameras",
    "laser": "the grid with the laser on, to calibrate the light sheets (its line: sensor.html)",
    "hand-eye": "a posture over the flat plate, to calibrate the hand-eye",
    "plate": "the plate again, scanned by hand",
    "ball": "a ball of known diameter",
    "steps": "gauge blocks",
    "still-step": "a gauge block, standing still",
    "part": "the free-form part",
    "waves": "a wavy plate",
}


def head_data(demo: HeadDemo) -> dict[str, Any]:
    """The figures of one head: fractions are 0 to 1, lengths in mm, angles in degrees."""
    sensor, errors = demo.sensor, demo.hand_eye
    variance = np.diag(total_covariance(demo.scanner))
    cameras = [sensor.camera, *([] if sensor.second is None else [sensor.second.camera])]
    seen = _instants([demo.scans[scene] for scene in ("plate", "ball", "part")])
    return {
        "camera": [{"rms_px": camera.rms_px} for camera in cameras],
        "sheets": [{"name": sheet.name, "rms_mm": sheet.rms_mm} for sheet in sensor.sheets],
        "hand_eye": {
            "rotation_error_deg": errors.rotation_deg,
            "translation_error_mm": errors.translation_mm,
            "sigma_rotation_deg": float(np.degrees(np.sqrt(variance[:3].sum()))),
            "sigma_translation_mm": float(np.sqrt(variance[3:].sum())),
            "normalised_error": errors.normalised,
        },
        "plate": {
            **_counts(demo.plate.counts),
            **_shares(demo.plate.fitted),
            "std_mm": demo.plate.fitted.value("std_mm"),
            "reference": demo.plate.fitted.reference,
        },
        "sphere": {
            **_counts(demo.ball.counts),
            **_shares(demo.ball.nominal),
            "diameter_mm": demo.ball.diameter.value_mm,
            "diameter_error_mm": demo.ball.diameter.value_mm - demo.ball.nominal_diameter_mm,
            "diameter_sigma_mm": demo.ball.diameter.sigma_mm,
            "reference": demo.ball.nominal.reference,
        },
        "steps": [
            *(_step(step, "Base") for step in demo.steps),
            _step(demo.still_step, "Sensor"),
        ],
        "part": {
            "n_points": len(demo.part.distance_mm),
            "n_measured": len(demo.part.distance_mm) + demo.part.n_elsewhere,
            "n_beyond_1mm": demo.part.n_elsewhere,
            "rms_mm": demo.part.rms_mm,
            "fraction_within_0p05mm": demo.part.fraction_within(0.05),
            "normalised_rms": demo.part.normalised_rms,
        },
        "named_stripes_per_exposure": float(np.mean([n_sheets for n_sheets, _ in seen])),
        "points_per_exposure": float(np.mean([n_points for _, n_points in seen])),
        "naming": {
            scene: {
                **asdict(found),
                "wrong_share": found.wrong_share,
                "named_share": found.named_share,
            }
            for scene, found in demo.naming.items()
        },
    }


def _instants(scans: Sequence[ScanReconstruction]) -> list[tuple[int, int]]:
    """Light sheets that gave a measured point, and measured points, of every instant.

    What two cameras saw at one instant counts once.
    """
    found: dict[tuple[int, int], tuple[set[int], int]] = {}
    for number, scan in enumerate(scans):
        for row, image in zip(scan.image_rows, scan.images, strict=True):
            key = (number, scan.exposures[row].row.t_ns)
            sheets, count = found.get(key, (set(), 0))
            measured = image.status == PointStatus.MEASURED
            found[key] = (
                sheets | set(image.sheet[measured].tolist()),
                count + int(measured.sum()),
            )
    return [(len(sheets), count) for sheets, count in found.values()]


def _shares(deviations: Deviations) -> dict[str, float]:
    return {
        f"fraction_within_{limit:g}mm".replace(".", "p"): float(
            np.mean(np.abs(deviations.deviations_mm) <= limit)
        )
        for limit in (0.03, 0.05, 0.08)
    }


def _counts(counts: PointCounts) -> dict[str, int]:
    """Points of the feature, of the cloud, and those further from the feature than 1 mm."""
    return {
        "n_points": counts.n_feature,
        "n_measured": counts.n_region,
        "n_beyond_1mm": counts.n_region - counts.n_feature,
    }


def _step(step: StepInspection, frame: str) -> dict[str, Any]:
    return {
        "nominal_mm": step.nominal_height_mm,
        "mean_mm": float(step.heights_mm.mean()),
        "std_mm": float(step.heights_mm.std(ddof=1)),
        "fitted_mm": step.height.value_mm,
        "fitted_sigma_mm": step.height.sigma_mm,
        "n_points": step.counts.n_feature,
        "n_measured": step.counts.n_region,
        "frame": frame,
    }


def _points(figures: Figures) -> str:
    """How many points a figure is over, and of how many that were measured."""
    text = f"{figures['n_points']:,} points of {figures['n_measured']:,} measured"
    beyond = figures.get("n_beyond_1mm")
    return text if beyond is None else f"{text}, {beyond:,} beyond 1 mm"


def _share(figures: Figures, limit: str) -> str:
    return share_text(100.0 * figures[f"fraction_within_0p{limit}mm"])


def _steps(head: Figures, frame: str) -> str:
    return "; ".join(
        f"{step['nominal_mm']:g} mm: {step['mean_mm']:.4f} mm, points' standard deviation "
        f"{step['std_mm']:.4f} mm ({_points(step)})"
        for step in head["steps"]
        if step["frame"] == frame
    )


def _hand_eye(head: Figures, part: str, unit: str) -> str:
    error, expected = (
        significant(head["hand_eye"][key], digits=2) + unit
        for key in (part.replace("_", "_error_"), f"sigma_{part}")
    )
    return f"{error} from the truth, expected {expected}"


def _wrong(head: Figures) -> str:
    n_wrong = sum(found["n_wrong"] for found in head["naming"].values())
    n_checked = sum(found["n_named"] for found in head["naming"].values())
    return f"{n_wrong} of {n_checked:,}" if head["naming"] else "one sheet"


ROWS: Mapping[str, Callable[[Figures], str]] = {
    "cameras, light sheets": lambda h: f"{len(h['camera'])}, {len(h['sheets'])}",
    "stripes named an exposure": lambda h: f"{h['named_stripes_per_exposure']:.2f}",
    "points an exposure": lambda h: f"{h['points_per_exposure']:,.0f}",
    f"points a second at {FRAMES_A_SECOND} exposures a second": lambda h: (
        f"{FRAMES_A_SECOND * h['points_per_exposure']:,.0f}"
    ),
    "wrong names among the points": _wrong,
    "plate within 0.08 mm": lambda h: f"{_share(h['plate'], '08')}",
    "plate within 0.05 mm": lambda h: (
        f"{_share(h['plate'], '05')} of {_points(h['plate'])} ({h['plate']['reference']} plane)"
    ),
    "plate within 0.03 mm": lambda h: _share(h["plate"], "03"),
    "plate, standard deviation": lambda h: f"{1000.0 * h['plate']['std_mm']:.1f} µm",
    "ball of 34.96 mm: diameter": lambda h: (
        f"{h['sphere']['diameter_mm']:.4f} mm, {h['sphere']['diameter_error_mm']:+.4f} mm off"
    ),
    "ball within 0.05 mm": lambda h: (
        f"{_share(h['sphere'], '05')} of {_points(h['sphere'])} ({h['sphere']['reference']} radius)"
    ),
    "step, one exposure at rest": lambda h: _steps(h, "Sensor"),
    "steps, through the arm": lambda h: _steps(h, "Base"),
    "part, from the true surface": lambda h: f"{1000.0 * h['part']['rms_mm']:.1f} µm rms",
    "hand-eye, rotation": lambda h: _hand_eye(h, "rotation_deg", "°"),
    "hand-eye, translation": lambda h: _hand_eye(h, "translation_mm", " mm"),
}
"""What is told of a head, in this order."""


def comparison_table(heads: Mapping[str, Figures]) -> Table:
    """One head beside the thesis, or several beside each other with its figures in brackets."""
    rows: list[tuple[str, ...]] = []
    for label, text in ROWS.items():
        printed = THESIS.get(label, {})
        if len(heads) == 1:
            ((name, head),) = heads.items()
            rows.append((label, printed.get(name, "–"), text(head)))
            continue
        cells = (
            f"{text(head)} [{printed[name]}]" if name in printed else text(head)
            for name, head in heads.items()
        )
        rows.append((label, *cells))
    ours = ["ours (simulated)"] if len(heads) == 1 else [KINDS[name] for name in heads]
    columns = ("", "thesis (real)", *ours) if len(heads) == 1 else ("", *ours)
    return Table(columns, tuple(rows), "", tuple(range(1, len(columns))))


def truth_table(demo: HeadDemo, head: Figures) -> Table:
    """Errors of the calibrations and of the part, also in their own sigmas."""
    part, hand_eye = demo.part, demo.hand_eye
    cameras = ("Camera",) if len(demo.cameras) == 1 else ("Left camera", "Right camera")
    rows = [
        (
            f"{name}: focal length",
            f"{camera.focal_px:+.2f} px",
            _sigmas(camera.normalised, camera.n_parameters),
        )
        for name, camera in zip(cameras, demo.cameras, strict=True)
    ]
    names = [f"Light sheet {sheet.name}" for sheet in demo.sensor.sheets]
    rows += [
        (
            "Light sheet" if len(names) == 1 else name,
            f"{significant(sheet.angle_deg, digits=2)}°, {significant(sheet.rms_mm, 'mm rms', 2)}",
            _sigmas(sheet.normalised, sheet.n_parameters),
        )
        for name, sheet in zip(names, demo.sheets, strict=True)
    ]
    rows += [
        (
            "Hand-eye",
            f"{significant(hand_eye.rotation_deg, digits=2)}°, "
            f"{significant(hand_eye.translation_mm, 'mm', 2)}",
            _sigmas(hand_eye.normalised, 6),
        ),
        (
            "Points on the part",
            f"{significant(part.rms_mm, 'mm rms')} of {_points(head['part'])}",
            f"{part.normalised_rms:.2f} rms (1 is usual)",
        ),
    ]
    return Table(("", "error", "in its own sigmas"), tuple(rows), "", (1, 2))


def _sigmas(length: float, n_parameters: int) -> str:
    return f"{length:.1f} ({n_parameters**0.5:.1f} is usual for {n_parameters} numbers)"


def naming_table(naming: Mapping[Any, NamingErrors]) -> Table:
    """Names of the stripes against the truth, scene by scene."""
    rows = []
    for scene, found in [*naming.items(), ("together", sum(naming.values(), NamingErrors()))]:
        n_measured = found.n_named + found.n_stray
        stray = 100.0 * found.n_stray / max(n_measured, 1)
        rows.append(
            (
                str(scene),
                f"{found.n_stripes_named} of {found.n_stripes_in_view}",
                f"{100.0 * found.named_share:.2f} % of {found.n_shared:,}",
                f"{found.n_wrong} of {found.n_named:,} ({100.0 * found.wrong_share:.3f} %)",
                f"{found.n_stray} of {n_measured:,} ({stray:.2f} %)",
                f"{found.n_ambiguous:,}",
                f"{found.n_unexplained:,}",
            )
        )
    columns = (
        "scene",
        "stripes named of those in view",
        "points named that every camera sees",
        "wrong name",
        "stray light measured",
        "dropped: ambiguous",
        "dropped: on no sheet",
    )
    return Table(columns, tuple(rows), "", (1, 2, 3, 4, 5, 6))


def head_demo_page(
    demo: HeadDemo,
    name: str,
    head: Figures,
    photographs: Mapping[str, Exposure],
    *,
    warnings: tuple[str, ...],
    commands: Table,
    footer: str,
) -> Page:
    """Lay out the page of one head.

    ``name``, ``head``: name of the head, and the same figures as `head_data` gives them.
    ``photographs``: one exposure of each scene, by the scene's name.
    """
    rule = Text(
        f"Of plate, ball and part, {FRACTION_RULE}. Of a step's faces the margins are left out. "
        "The thesis's figures were measured on a real instrument; ours are simulated, with an arm "
        "and optics made to be like it."
    )
    seconds = {**head["seconds"], "together": sum(head["seconds"].values())}
    took = tuple((stage.replace("_", " "), f"{value:.1f}") for stage, value in seconds.items())
    names = (
        Text(
            "Which light sheet drew each stripe, against the truth, over all instants of each "
            "scene. What is in doubt is dropped and counted, not guessed. Stray light is what lies "
            "more than 2 px from every true stripe: faint light along a silhouette or an edge, or "
            "a reflection."
        ),
        naming_table(demo.naming),
    )
    return Page(
        title=f"A {KINDS[name].removeprefix('single-')} scanner on a measuring arm",
        subtitle="Calibrated and used. Everything below was measured on rendered images and a "
        "simulated arm; the simulator's truth was looked at only afterwards.",
        cards=_cards(head),
        warnings=warnings,
        sections=(
            Section("Against the thesis", (comparison_table({name: head}), rule)),
            Section("What the camera saw", (_photographs(demo, photographs),)),
            Section(
                "Where the sensor sits on the arm",
                (
                    Facts(for_people(hand_eye_quantities(demo.scanner))),
                    Text("scanner.html tells how it was found, posture by posture."),
                ),
            ),
            Section("The plate, the ball and the blocks", (_histograms(demo),)),
            Section("The part", (Text("These points are cloud.ply."), _part_pictures(demo))),
            *((Section("The names of the stripes", names),) if demo.naming else ()),
            Section("Against the truth", (truth_table(demo, head),)),
            Section("Step by step", (commands, Table(("stage", "seconds"), took))),
        ),
        is_simulated=True,
        footer=footer,
    )


def _cards(head: Figures) -> tuple[Quantity, ...]:
    plate, ball, hand_eye = head["plate"], head["sphere"], head["hand_eye"]
    still = next(step for step in head["steps"] if step["frame"] == "Sensor")
    return (
        fact(
            "Plate",
            _share(plate, "05"),
            f"within 0.05 mm; std {1000.0 * plate['std_mm']:.1f} µm, {plate['n_points']:,} points",
        ),
        fact(
            "Ball",
            f"{1000.0 * ball['diameter_error_mm']:+.1f} µm",
            f"error of the diameter, sigma {1000.0 * ball['diameter_sigma_mm']:.1f} µm; "
            f"{_share(ball, '05')} within 0.05 mm",
        ),
        fact(
            "Step, one exposure",
            f"{1000.0 * (still['mean_mm'] - still['nominal_mm']):+.1f} µm",
            f"error of {still['nominal_mm']:g} mm; std {1000.0 * still['std_mm']:.1f} µm",
        ),
        fact(
            "Hand-eye",
            f"{1000.0 * hand_eye['translation_error_mm']:.0f} µm, "
            f"{hand_eye['rotation_error_deg']:.3f}°",
            f"off; expected {1000.0 * hand_eye['sigma_translation_mm']:.0f} µm, "
            f"{hand_eye['sigma_rotation_deg']:.3f}°",
        ),
        fact(
            "Free-form part",
            f"{1000.0 * head['part']['rms_mm']:.1f} µm rms",
            f"{_share(head['part'], '05')} within 0.05 mm of the truth",
        ),
    )


def _photographs(demo: HeadDemo, photographs: Mapping[str, Exposure]) -> Gallery:
    """One image a scene; where sheets were named, its measured points in their colours."""
    profiles = {
        (scene, image.profile.source): image
        for scene, scan in demo.scans.items()
        for image in scan.images
        if demo.naming
    }
    pictures = []
    for scene in (known for known in SCENE_TEXTS if known in photographs):
        exposure, marks, text = photographs[scene], [], SCENE_TEXTS[scene]
        for (of_scene, source), image in profiles.items():
            if (of_scene, source) == (scene, exposure.source):
                measured = image.status == PointStatus.MEASURED
                marks = [
                    Marks(image.profile.points_px[measured & (image.sheet == k)], sheet_colour(k))
                    for k in sorted(set(image.sheet[measured].tolist()))
                ]
                text += ", coloured by sheet"
        markup = photo_markup(exposure, marks, f"Rendered image: {text}", longest_px=900)
        pictures.append(Picture(markup, text, scene))
    return Gallery(tuple(pictures), 300)


def _histograms(demo: HeadDemo) -> Gallery:
    """Plate, ball and blocks, as the thesis shows them."""
    ball = deviation_histogram(
        demo.ball.nominal,
        title="Ball (as figure 5.14)",
        axis_label="distance to the centre minus the radius, mm",
    )
    steps = [
        height_histogram(
            step.heights_mm,
            step.nominal_height_mm,
            step.height.value_mm,
            title=f"Step of {step.nominal_height_mm:g} mm, {how}",
        )
        for step, how in (
            (demo.still_step, "one exposure (as figure 5.19)"),
            *((step, "through the arm") for step in demo.steps),
        )
    ]
    return Gallery((_plate_histogram(demo, "Plate (as figure 5.12)"), ball, *steps), 420)


def _plate_histogram(demo: HeadDemo, title: str) -> Picture:
    return deviation_histogram(demo.plate.fitted, title=title, axis_label="distance to plane, mm")


def _part_pictures(demo: HeadDemo) -> Gallery:
    """The part in space and its deviations."""
    cloud, part = demo.scans["part"].cloud, demo.part
    deviations = deviation_view(
        cloud.points_mm[part.rows],
        part.distance_mm,
        title="Deviation from the true surface",
        frame="Base",
        reference="the true surface, which only a simulator knows",
    )
    return Gallery((cloud_view(cloud), deviations), 460)


def heads_page(heads: Mapping[str, Figures], demos: Mapping[str, HeadDemo], footer: str) -> Page:
    """Lay out the comparison of several heads, as figures 5.25 and 5.40 to 5.42 do."""
    reading = Text(
        "In brackets: the thesis's own figures, measured on real heads, whose lines and windows "
        "differ from these. The single line lies along the long side of the camera's window, the "
        "others cross it at about 45°: a line has fewer points there. How many points a head "
        "yields also depends on what it looks at."
    )
    at_once, scanned, plates = [], [], []
    for name, demo in demos.items():
        scan = demo.scans["part"]
        times = np.array([scan.exposures[row].row.t_ns for row in scan.image_rows])
        of_point = times[scan.cloud.exposure]
        instants = np.unique(of_point)
        one = np.asarray(of_point == instants[len(instants) // 2])
        title = f"{KINDS[name]}: one exposure, {int(one.sum()):,} points"
        at_once.append(_by_sheet(scan.cloud, one, title))
        every = np.ones(len(scan.cloud), dtype=np.bool_)
        scanned.append(_by_sheet(scan.cloud, every, f"{KINDS[name]}: the part"))
        plates.append(_plate_histogram(demo, f"{KINDS[name]}: plate"))
    return Page(
        title="Three heads on the same scenes",
        subtitle="One line, two crossed lines and eleven lines on the same simulated arm, before "
        "the same plate, ball, blocks and part.",
        cards=(),
        warnings=(),
        sections=(
            Section("Beside each other", (comparison_table(heads), reading)),
            Section("One exposure (as figure 5.42)", (Gallery(tuple(at_once), 380),)),
            Section("The part, scanned (as figure 5.25)", (Gallery(tuple(scanned), 380),)),
            Section("The plate (as figures 5.12, 5.28, 5.41)", (Gallery(tuple(plates), 380),)),
        ),
        is_simulated=True,
        footer=footer,
    )


def _by_sheet(cloud: PointCloud, chosen: BoolArray, title: str) -> Picture:
    rows = np.flatnonzero(chosen)
    step = max(1, -(-len(rows) // MAX_SHOWN))
    shown = rows[::step]
    points, sheet = cloud.points_mm[shown], cloud.sheet[shown]
    dots = [uniform_dots(points[sheet == k], sheet_colour(k)) for k in np.unique(sheet)]
    every = f" One point in {step} is shown." if step > 1 else ""
    markup = scene_markup(dots, [], [], title, is_z_up=True)
    return Picture(markup, f"Colour is the light sheet.{every}", title)
