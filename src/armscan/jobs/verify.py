# SPDX-License-Identifier: Apache-2.0
"""From a recording of a probed artefact to verdicts on a scanner, and the page about them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

from armscan.calibration.hand_eye.probed_plate import ProbeSide
from armscan.errors import OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.inspection.conformity import RULE, Check, Verdict
from armscan.inspection.results import SphereInspection
from armscan.inspection.selection import InspectionOptions
from armscan.jobs.inspect import read_plate
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.pipeline.verify import (
    Measured,
    Verification,
    VerifyOptions,
    verify_on_ball,
    verify_on_plate,
)
from armscan.report.inspect import InspectionReport, inspection_page, plane_report, sphere_report
from armscan.report.page import Card, Section, Text, render_page
from armscan.report.quantity import Summary, Table, sentence, significant
from armscan.storage.clouds import read_cloud
from armscan.storage.documents import new_provenance, read_scanner_calibration
from armscan.storage.files import check_outputs, write_files
from armscan.storage.image_paths import are_simulated
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import EXPOSURES_FILE

ADVICE: dict[Verdict, str] = {
    "still valid": "the calibration may be used",
    "not valid": "do not measure: clean head and standard and test again; if it fails again, "
    "calibrate the hand-eye anew",
    "inconclusive": "the test cannot tell: scan the standard again with more postures",
}


@dataclass(frozen=True, slots=True)
class VerifyRequest:
    """What to verify, on what, and where to write.

    Parameters
    ----------
    scan
        A recording's folder, or a cloud in Base.
    scanner
        ``scanner.json``; may be None for a cloud only.
    ball_mm
        Diameter of the standard ball; None if a plate was scanned.
    plate
        Probed points of the plate, or its coefficients; None if a ball was scanned.
    region
        ``xmin, xmax, ymin, ymax, zmin, zmax`` in mm; empty for all.
    options
        How it is judged.
    output
        Page to write, or None for none.
    inspection
        What belongs to ball or plate.
    is_overwriting
        Replace a page that exists.
    command
        The command line, for the record.
    side
        Side of the plate that was touched; None to take it from where the tool was.
    """

    scan: Path
    scanner: Path | None
    ball_mm: float | None = None
    plate: Path | None = None
    region: tuple[float, ...] = ()
    options: VerifyOptions = field(default_factory=VerifyOptions)
    output: Path | None = None
    inspection: InspectionOptions = field(default_factory=InspectionOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()
    side: ProbeSide | None = None


def run_verification(
    request: VerifyRequest, progress: Progress = silent
) -> tuple[Summary, Verdict]:
    """Measure, compare with what the calibration predicts, and judge.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the standard is not found; nothing is
        written then.
    """
    _check(request)
    measured, is_simulated = _measured(request, progress)
    result = _verified(request, measured)
    report = _report(request, result, measured)
    written: tuple[Path, ...] = ()
    if request.output is not None:
        provenance = new_provenance(
            _inputs(request),
            command=request.command,
            options=(request.options, request.inspection),
            warnings=report.warnings,
            forced=measured.cloud.forced,
        )
        blocks = (
            Text(verdict_sentence(result)),
            checks_table(result.checks),
            definitions_table(result.checks),
        )
        first = (Section("Verdict", blocks),)
        page = inspection_page(report, provenance, is_simulated=is_simulated, first=first)
        write_files({request.output: render_page(page)}, is_overwriting=request.is_overwriting)
        written = (request.output,)
    summary = _summary(result, report, written, is_simulated=is_simulated)
    return replace(summary, forced=measured.cloud.forced), result.verdict


def verdict_sentence(result: Verification) -> str:
    """Verdict, advice and rule."""
    return f"{sentence(result.verdict)} {sentence(ADVICE[result.verdict])} Rule: {RULE}."


def checks_table(checks: tuple[Check, ...]) -> Table:
    """Every check with its limit and verdict."""
    rows = tuple(
        (
            check.name,
            _value(check, check.error),
            _value(check, check.predicted),
            _value(check, check.limit),
            _value(check, check.uncertainty),
            check.verdict,
        )
        for check in checks
    )
    heads = ("check", "error E", "predicted spread", "limit MPE", "uncertainty U", "verdict")
    return Table(heads, rows, "", (5,))


def definitions_table(checks: tuple[Check, ...]) -> Table:
    """What the numbers of the checks are."""
    rows = tuple(
        (check.name, check.definition, check.limit_rule, check.uncertainty_rule) for check in checks
    )
    return Table(("check", "E is", "MPE is", "U holds"), rows, "", (1, 2, 3))


def _check(request: VerifyRequest) -> None:
    if (request.ball_mm is None) == (request.plate is None):
        raise OptionError(
            "a check needs one standard", remedy="give either --ball DIAMETER or --plate FILE"
        )
    if request.side is not None and request.plate is None:
        raise OptionError("a side needs a plate", where="--side", remedy="give --plate")
    if request.ball_mm is not None and not 0.0 < request.ball_mm < math.inf:
        raise OptionError(
            f"a diameter of {request.ball_mm} mm", where="--ball", remedy="give the diameter in mm"
        )
    if request.region:
        Box.from_limits(request.region, "--region")
    if request.scan.is_dir() and request.scanner is None:
        raise OptionError("a recording needs the scanner's calibration", remedy="give --scanner")
    if request.output is not None:
        if request.output.suffix.lower() != ".html":
            raise OptionError(
                f"the output's name ends in '{request.output.suffix}'",
                where=f"-o {request.output}",
                remedy="end it in .html",
            )
        check_outputs((request.output,), is_overwriting=request.is_overwriting)


def _measured(request: VerifyRequest, progress: Progress) -> tuple[Measured, bool]:
    if not request.scan.is_dir():
        cloud = read_cloud(request.scan)
        if cloud.frame == "Sensor":
            raise OptionError(
                "the cloud is in the Sensor frame, where hand-eye and arm took no part",
                where=str(request.scan),
                remedy="give a recording with the arm's poses, or a cloud made from one",
            )
        return Measured(cloud), cloud.is_simulated or are_simulated(_inputs(request))
    source = read_recording(request.scan)
    scanner = None if request.scanner is None else read_scanner_calibration(request.scanner)
    if scanner is None:
        raise OptionError("a recording needs the scanner's calibration", remedy="give --scanner")
    scan = measure_scan(source, scanner, ScanOptions(has_normals=False), progress=progress)
    is_simulated = source.is_simulated or are_simulated(_inputs(request))
    return Measured(scan.cloud, scan, scanner), is_simulated


def _inputs(request: VerifyRequest) -> tuple[Path, ...]:
    scan = request.scan / EXPOSURES_FILE if request.scan.is_dir() else request.scan
    return tuple(path for path in (scan, request.scanner, request.plate) if path is not None)


def _verified(request: VerifyRequest, measured: Measured) -> Verification:
    region = None
    if request.region:
        region = Box.from_limits(request.region, "--region")
    if request.ball_mm is not None:
        return verify_on_ball(
            measured,
            request.ball_mm,
            request.options,
            region=region,
            inspection=request.inspection,
        )
    if request.plate is None:
        raise OptionError("a check needs one standard", remedy="give --ball or --plate")
    plate, weak = read_plate(
        request.plate,
        measured.cloud.points_mm.mean(axis=0),
        towards_mm=_tool_places(measured),
        side=request.side,
    )
    found = verify_on_plate(
        measured, plate, request.options, region=region, inspection=request.inspection
    )
    return replace(found, warnings=(*weak, *found.warnings))


def _tool_places(measured: Measured) -> FloatArray | None:
    """(M, 3) places of the arm's tool; None where not known."""
    if measured.scan is None:
        return None
    poses = measured.scan.poses
    found = poses.translations_mm[poses.has_pose]
    return found if len(found) else None


def _report(request: VerifyRequest, result: Verification, measured: Measured) -> InspectionReport:
    found, cloud = result.found, measured.cloud
    if isinstance(found, SphereInspection):
        base = sphere_report(found, cloud)
    else:
        base = plane_report(found, cloud)
    scan_warnings = () if measured.scan is None else measured.scan.warnings
    cards = (
        Card("Verdict", result.verdict, ADVICE[result.verdict]),
        *(
            Card(
                check.name.capitalize(),
                _value(check, check.error),
                f"limit {_value(check, check.limit)}: {check.verdict}",
            )
            for check in result.checks
        ),
    )
    return InspectionReport(
        title=f"Scanner verified: {result.verdict}",
        subtitle=f"{request.scan.name}: {base.subtitle}",
        cards=(*cards, *base.cards[-1:]),
        facts=base.facts,
        references=base.references,
        histograms=base.histograms,
        views=base.views,
        counts=base.counts,
        geometry=base.geometry,
        warnings=(*result.warnings, *scan_warnings, *base.warnings),
        data=base.data,
    )


def _summary(
    result: Verification,
    report: InspectionReport,
    written: tuple[Path, ...],
    *,
    is_simulated: bool,
) -> Summary:
    lines = tuple(
        (
            check.name,
            f"E {_value(check, check.error)}, limit {_value(check, check.limit)} "
            f"({check.limit_rule}), U {_value(check, check.uncertainty)}: {check.verdict}",
        )
        for check in result.checks
    )
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        facts=(*lines, ("advice", ADVICE[result.verdict]), ("rule", RULE), *report.facts),
        warnings=tuple(sentence(warning) for warning in report.warnings),
        written=written,
        next_step=f"open {written[0]}" if written else "",
        data={
            "kind": "verification",
            "simulated": is_simulated,
            "verdict": result.verdict,
            "rule": RULE,
            "checks": [
                {
                    "name": check.name,
                    "definition": check.definition,
                    "unit": check.unit,
                    "error": check.error,
                    "predicted_sigma": check.predicted,
                    "limit": check.limit,
                    "limit_rule": check.limit_rule,
                    "uncertainty": check.uncertainty,
                    "uncertainty_rule": check.uncertainty_rule,
                    "verdict": check.verdict,
                }
                for check in result.checks
            ],
            "inspection": dict(report.data),
        },
    )


def _value(check: Check, value: float) -> str:
    return significant(value, check.unit, 2)
