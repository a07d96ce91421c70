# SPDX-License-Identifier: Apache-2.0
"""From touches of the arm's probe to a plate's plane and the points on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armscan.calibration.hand_eye.probed_plate import ProbedPlate, ProbingOptions, fit_probed_plate
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.jobs.job import Job, solved
from armscan.models.arm import tip_centres, tool_from_probe
from armscan.records.points import ProbedPoints
from armscan.report.quantity import Quantity, Summary, Table, sentences, significant
from armscan.storage.arm import ARM_FILE, PROBE_FILE, read_probe_tip
from armscan.storage.files import holds_files, path_text
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import probed_points_csv, read_probed_points
from armscan.storage.recording import read_arm_track


@dataclass(frozen=True, slots=True, eq=False)
class Touches:
    """Touches as read: the points, where the tool was (None if not known), what is odd."""

    points: ProbedPoints
    towards_mm: FloatArray | None
    warnings: tuple[str, ...]


def probe(
    job: Job, source: Path, tip: Path | None = None, options: ProbingOptions | None = None
) -> Summary:
    """Read the touches, fit the plane, write the points on the surface.

    ``source``: a folder with ``arm.csv``, a sample a touch, and ``probe.toml``; or a table of
    points. ``tip``: the tip's file if it is not ``probe.toml`` of the folder.
    """
    job.places(".csv", reads=(source,))
    touches = read_touches(source, tip)
    fit = fit_probed_plate(touches.points, touches.towards_mm, options or ProbingOptions())
    plate = solved(fit, source)
    written: tuple[Path, ...] = ()
    if job.output is not None:
        surface = ProbedPoints(
            plate.surface_mm[plate.is_used],
            plate.reference.tip_diameter_mm,
            is_compensated=True,
        )
        written = job.write({job.output: probed_points_csv(surface)})
    is_simulated = are_simulated((source / ARM_FILE if holds_files(source) else source,))
    next_step = f"armscan calibrate hand-eye SCAN --sensor sensor.json --plate {job.output}"
    return Summary(
        title="Plate probed" + (" (simulated)." if is_simulated else "."),
        quantities=plate_quantities(plate),
        tables=(_touch_table(plate),),
        warnings=sentences((*touches.warnings, *plate.warnings)),
        written=written,
        next_step=f"{next_step} -o scanner.json" if written else "",
        extra={"kind": "probed plate", "simulated": is_simulated},
    )


def read_touches(source: Path, tip: Path | None = None) -> Touches:
    """Read the touches of a folder, or of a table of points; arguments as `probe`."""
    if not holds_files(source):
        if tip is not None:
            raise OptionError(
                "a table of points says itself how large the tip was",
                where="--probe",
                remedy="write '# point = tip-centre, tip_diameter_mm = 6' into the table",
            )
        return Touches(read_probed_points(source), None, ())
    track, notes = read_arm_track(source)
    known = read_probe_tip(tip or source / PROBE_FILE)
    centres = tip_centres(track, tool_from_probe(known.centre_tool_mm))
    rows = tuple(int(row) + 1 for row in np.flatnonzero(track.is_known))
    points = ProbedPoints(centres, known.diameter_mm, source=path_text(source), rows=rows)
    n_gaps = int((~track.is_known).sum())
    gaps = (f"for {n_gaps} of {len(track)} touches the arm gave no pose",) if n_gaps else ()
    return Touches(points, track.translations_mm[track.is_known], (*notes, *gaps))


def plate_quantities(plate: ProbedPlate) -> tuple[Quantity, ...]:
    """What is told of a probed plate."""
    reference = plate.reference
    plane = reference.plane
    rms = float(np.sqrt(np.mean(plate.residual_mm[plate.is_used] ** 2)))
    points = f"{reference.n_points} of {len(plate.is_used)} touches"
    if reference.tip_diameter_mm:
        points += f", tip of {reference.tip_diameter_mm:g} mm compensated"
    else:
        points += (
            ", taken to be on the surface: no tip's radius was taken off; above centres of a tip "
            "write '# point = tip-centre, tip_diameter_mm = 6'"
        )
    text_of_plane = " ".join(f"{value:.9g}" for value in plane.coefficients) + " (D in mm)"
    tilt_1 = tilt_2 = offset = None
    text = ""
    if reference.covariance is not None:
        tilt_1, tilt_2, offset = np.sqrt(np.diag(reference.covariance)).tolist()
        text = (
            f"{significant(np.degrees(tilt_1))} and {significant(np.degrees(tilt_2))} degrees of "
            f"tilt, {significant(offset)} mm of height, by the scatter of the touches and the "
            "sigma taken for one"
        )
    return (
        Quantity("n_used", "points", reference.n_points, shown=points),
        Quantity("n_touches", "", len(plate.is_used)),
        Quantity("tip_diameter_mm", "", reference.tip_diameter_mm),
        Quantity("plane", "A B C D", plane.coefficients.tolist(), shown=text_of_plane),
        Quantity("point_mm", "", plane.point_mm.tolist()),
        Quantity("axes", "", plane.axes.tolist()),
        Quantity("side", "side", plate.side_from),
        Quantity(
            "flatness_mm",
            "flatness",
            plate.flatness_mm,
            unit="mm",
            meaning="largest minus smallest distance",
        ),
        Quantity("rms_mm", "rms", rms, unit="mm"),
        Quantity("sigma_tilt_1_rad", "sigma" if text else "", tilt_1, shown=text),
        Quantity("sigma_tilt_2_rad", "", tilt_2),
        Quantity("sigma_offset_mm", "", offset),
        Quantity("outliers", "", [plate.rows[k] for k in plate.outliers]),
        Quantity("residual_mm", "", plate.residual_mm.tolist()),
    )


def _touch_table(plate: ProbedPlate) -> Table:
    rows = []
    for k, (point, residual) in enumerate(zip(plate.surface_mm, plate.residual_mm, strict=True)):
        remark = "" if plate.is_used[k] else "left out"
        if k in plate.outliers and plate.is_used[k]:
            remark = "does not fit the others"
        place = tuple(f"{value:.3f}" for value in point)
        rows.append((str(plate.rows[k]), *place, f"{residual:+.4f}", remark))
    columns = ("row", "x mm", "y mm", "z mm", "distance mm", "")
    return Table(columns, tuple(rows), "Points on the surface, in Base", (5,))
