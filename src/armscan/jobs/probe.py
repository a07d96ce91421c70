# SPDX-License-Identifier: Apache-2.0
"""From touches of the arm to points on the surface of a plate."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armscan.calibration.hand_eye.probed_plate import ProbedPlate, ProbingOptions, fit_probed_plate
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.probe import tip_centres, tool_from_probe
from armscan.records.points import ProbedPoints
from armscan.report.quantity import Summary, Table, sentence, significant
from armscan.storage.arm import ARM_FILE, PROBE_FILE, read_probe_tip
from armscan.storage.files import check_outputs, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import probed_points_csv, read_probed_points
from armscan.storage.recording import read_arm_track


@dataclass(frozen=True, slots=True)
class ProbeRequest:
    """What was touched, and where to write.

    Parameters
    ----------
    source
        A folder with ``arm.csv``, a sample a touch, and ``probe.toml``; or a table of points.
    output
        Table of the points on the surface, ``plate.csv``; None to write none.
    probe
        The tip's file if it is not ``probe.toml`` of the folder.
    options
        Side, outliers, feature.
    is_overwriting
        Replace a table that exists.
    """

    source: Path
    output: Path | None = None
    probe: Path | None = None
    options: ProbingOptions = field(default_factory=ProbingOptions)
    is_overwriting: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Touches:
    """Touches as read: the points, where the tool was (None if not known), what is odd."""

    points: ProbedPoints
    towards_mm: FloatArray | None
    warnings: tuple[str, ...]


def run_probing(request: ProbeRequest) -> Summary:
    """Read the touches, fit the plane, write the points on the surface.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the touches determine no plate; nothing is
        written then.
    """
    if request.output is not None:
        if request.output.suffix.lower() != ".csv":
            raise OptionError(
                f"the output's name ends in '{request.output.suffix}'",
                where=f"-o {request.output}",
                remedy="end it in .csv",
            )
        check_outputs((request.output,), is_overwriting=request.is_overwriting)
    touches = read_touches(request.source, request.probe)
    plate = fit_probed_plate(touches.points, touches.towards_mm, request.options)
    if isinstance(plate, FitFailure):
        raise EstimationError(plate.reason, where=str(request.source), remedy=plate.remedy)
    written: tuple[Path, ...] = ()
    if request.output is not None:
        surface = ProbedPoints(
            points_mm=plate.surface_mm[list(plate.is_used)],
            tip_diameter_mm=plate.reference.tip_diameter_mm,
            is_compensated=True,
        )
        write_files(
            {request.output: probed_points_csv(surface)}, is_overwriting=request.is_overwriting
        )
        written = (request.output,)
    mark = request.source / ARM_FILE if request.source.is_dir() else request.source
    return probe_summary(plate, touches, written, is_simulated=are_simulated((mark,)))


def read_touches(source: Path, probe: Path | None = None) -> Touches:
    """Read the touches of a folder, or of a table of points; arguments as in `ProbeRequest`.

    Raises
    ------
    ArmscanError
        If a file is missing or damaged, the arm gave no pose, or a tip is given for a table.
    """
    if not source.is_dir():
        if probe is not None:
            raise OptionError(
                "a table of points says itself how large the tip was",
                where="--probe",
                remedy="write '# point = tip-centre, tip_diameter_mm = 6' into the table",
            )
        return Touches(read_probed_points(source), None, ())
    track, notes = read_arm_track(source)
    tip = read_probe_tip(probe or source / PROBE_FILE)
    centres = tip_centres(track, tool_from_probe(tip.centre_tool_mm))
    rows = tuple(int(row) + 1 for row in np.flatnonzero(track.is_known))
    points = ProbedPoints(
        points_mm=centres, tip_diameter_mm=tip.diameter_mm, source=str(source), rows=rows
    )
    n_gaps = int((~track.is_known).sum())
    gaps = (f"for {n_gaps} of {len(track)} touches the arm gave no pose",) if n_gaps else ()
    return Touches(points, track.translations_mm[track.is_known], (*notes, *gaps))


def probe_summary(
    plate: ProbedPlate, touches: Touches, written: tuple[Path, ...], *, is_simulated: bool
) -> Summary:
    """What a person, and a program, wants to know of a probed plate."""
    reference = plate.reference
    coefficients = reference.plane.coefficients
    sigma = _sigma(plate)
    rms = float(np.sqrt(np.mean(plate.residual_mm[list(plate.is_used)] ** 2)))
    points = f"{reference.n_points} of {len(plate.is_used)} touches"
    if reference.tip_diameter_mm:
        points += f", tip of {reference.tip_diameter_mm:g} mm compensated"
    facts = [
        ("points", points),
        ("A B C D", " ".join(f"{value:.9g}" for value in coefficients) + " (D in mm)"),
        ("side", plate.side_from),
        ("flatness", f"{significant(plate.flatness_mm)} mm, largest minus smallest distance"),
        ("rms", f"{significant(rms)} mm"),
    ]
    if sigma is not None:
        facts.append(
            (
                "sigma",
                f"{significant(np.degrees(sigma[0]))} and {significant(np.degrees(sigma[1]))} "
                f"degrees of tilt, {significant(sigma[2])} mm of height, by the scatter of the "
                "touches and the sigma taken for one",
            )
        )
    return Summary(
        title="Plate probed" + (" (simulated)." if is_simulated else "."),
        facts=tuple(facts),
        tables=(_touch_table(plate),),
        warnings=tuple(sentence(text) for text in (*touches.warnings, *plate.warnings)),
        written=written,
        next_step=(
            f"armscan calibrate hand-eye SCAN --sensor sensor.json --plate {written[0]} "
            "-o scanner.json"
            if written
            else ""
        ),
        data={
            "kind": "probed plate",
            "simulated": is_simulated,
            "n_touches": len(plate.is_used),
            "n_used": reference.n_points,
            "tip_diameter_mm": reference.tip_diameter_mm,
            "plane": coefficients.tolist(),
            "point_mm": reference.plane.point_mm.tolist(),
            "axes": reference.plane.axes.tolist(),
            "sigma_tilt_1_rad": None if sigma is None else sigma[0],
            "sigma_tilt_2_rad": None if sigma is None else sigma[1],
            "sigma_offset_mm": None if sigma is None else sigma[2],
            "flatness_mm": plate.flatness_mm,
            "rms_mm": rms,
            "side": plate.side_from,
            "outliers": [plate.rows[k] for k in plate.outliers],
            "residual_mm": plate.residual_mm.tolist(),
        },
    )


def _sigma(plate: ProbedPlate) -> tuple[float, float, float] | None:
    covariance = plate.reference.covariance
    if covariance is None:
        return None
    tilt_1, tilt_2, offset = (float(value) for value in np.sqrt(np.diag(covariance)))
    return tilt_1, tilt_2, offset


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
