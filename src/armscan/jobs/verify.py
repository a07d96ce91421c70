# SPDX-License-Identifier: Apache-2.0
"""From a scan of a ball or plate to the verdict on a scanner, and the page about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.probed_plate import ProbeSide
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.shapes import plane_from_coefficients
from armscan.inspection.conformity import RULE, Check, Verdict
from armscan.inspection.results import SphereInspection
from armscan.inspection.selection import InspectionOptions
from armscan.jobs.inspection.shapes import read_plate, region_of
from armscan.jobs.job import Job
from armscan.pipeline.progress import Progress
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.pipeline.verify import (
    Measured,
    Verification,
    VerifyOptions,
    verify_on_ball,
    verify_on_plate,
)
from armscan.records.cloud import PointCloud
from armscan.report.inspection.shapes import (
    InspectionReport,
    inspection_page,
    plane_report,
    sphere_report,
)
from armscan.report.page import Section, Text
from armscan.report.quantity import (
    Quantity,
    Summary,
    Table,
    fact,
    for_people,
    only,
    sentence,
    sentences,
    significant,
    values,
)
from armscan.storage.arm import read_arm_model
from armscan.storage.clouds import read_cloud_file
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.files import holds_files, path_text
from armscan.storage.image_paths import are_simulated
from armscan.storage.points import parse_plane
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import EXPOSURES_FILE

ADVICE: dict[Verdict, str] = {
    "still valid": "the calibration may be used",
    "not valid": "do not measure: clean head and standard and test again; if it fails again, "
    "calibrate the hand-eye anew",
    "inconclusive": "the test cannot tell: scan the standard again with more postures",
}


@dataclass(frozen=True, slots=True)
class Standard:
    """What was scanned to verify a scanner; `OptionError` if it is not one of them.

    Parameters
    ----------
    ball_mm
        Diameter of the standard ball; None if a plate was scanned.
    plate
        File of probed points of the plate, or of its coefficients; None for none.
    side
        Side of the plate that was touched; None to take it from where the tool was.
    plane
        ``A,B,C,D`` of the plate in Base, D in mm; empty for none.
    """

    ball_mm: float | None = None
    plate: Path | None = None
    side: ProbeSide | None = None
    plane: str = ""

    def __post_init__(self) -> None:
        if [self.ball_mm is None, self.plate is None, not self.plane].count(False) != 1:
            raise OptionError(
                "a check needs one standard",
                remedy="give one of --ball DIAMETER, --plate FILE and --plane A,B,C,D",
            )
        if self.side is not None and self.plate is None:
            raise OptionError("a side needs a plate", where="--side", remedy="give --plate")
        if self.ball_mm is not None and not 0.0 < self.ball_mm < math.inf:
            raise OptionError(
                f"a diameter of {self.ball_mm} mm", where="--ball", remedy="give the diameter in mm"
            )


def verify(
    job: Job,
    scan: Path,
    scanner: Path | None,
    standard: Standard,
    *,
    arm: Path | None = None,
    region: Sequence[float] = (),
    options: VerifyOptions | None = None,
    inspection: InspectionOptions | None = None,
) -> Summary:
    """Measure, compare with what the calibration predicts, and judge.

    ``scan``: a recording's folder, or a cloud in Base. ``scanner``: ``scanner.json``; may be None
    for a cloud only, which must have been measured with it. ``arm``: ``arm.toml`` for a recording
    of joint angles; None to look for it in the recording. ``region``: ``xmin, xmax, ymin, ymax,
    zmin, zmax`` in mm; empty for all.
    """
    options, inspection = options or VerifyOptions(), inspection or InspectionOptions()
    box = region_of(region)
    if holds_files(scan) and scanner is None:
        raise OptionError("a recording needs the scanner's calibration", remedy="give --scanner")
    job.places(".html")
    table = scan / EXPOSURES_FILE if holds_files(scan) else scan
    inputs = [path for path in (table, scanner, standard.plate, arm) if path is not None]
    measured, is_simulated, remarks = _measured(scan, scanner, arm, job.progress)
    is_simulated = is_simulated or are_simulated(inputs)
    unsaid = () if measured.scan is not None else _of_scanner(measured.cloud, scan, scanner)
    result = _verified(measured, standard, box, options, inspection)
    result = replace(result, warnings=(*remarks, *unsaid, *result.warnings))
    report = _report(scan.name, result, measured)
    forced = measured.cloud.forced
    written: tuple[Path, ...] = ()
    if job.output is not None:
        provenance = job.provenance(
            inputs, (options, inspection), warnings=report.warnings, forced=forced
        )
        words = f"{sentence(result.verdict)} {sentence(ADVICE[result.verdict])} Rule: {RULE}."
        checks = (Text(words), _checks_table(result.checks), _definitions_table(result.checks))
        page = inspection_page(
            report, provenance, is_simulated=is_simulated, first=(Section("Verdict", checks),)
        )
        written = job.write({job.output: page})
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        quantities=(
            *(
                fact(
                    check.name,
                    f"E {_value(check, check.error)}, limit {_value(check, check.limit)} "
                    f"({check.limit_rule}), U {_value(check, check.uncertainty)}: {check.verdict}",
                )
                for check in result.checks
            ),
            Quantity("", "advice", ADVICE[result.verdict]),
            Quantity("rule", "rule", RULE),
            *for_people(report.quantities),
        ),
        warnings=sentences(report.warnings),
        written=written,
        next_step=f"open {job.output}" if written else "",
        extra={
            "kind": "verification",
            "simulated": is_simulated,
            "verdict": result.verdict,
            "checks": [_check_data(check) for check in result.checks],
            "inspection": values(report.quantities),
        },
        forced=forced,
    )


def _measured(
    scan: Path, scanner: Path | None, arm: Path | None, progress: Progress
) -> tuple[Measured, bool, tuple[str, ...]]:
    """The points, whether they are of rendered images, and what to know of a cloud's reading."""
    if not holds_files(scan) or scanner is None:
        found = read_cloud_file(scan)
        cloud = found.cloud
        if cloud.frame == "Sensor":
            raise OptionError(
                "the cloud is in the Sensor frame, where hand-eye and arm took no part",
                where=str(scan),
                remedy="give a recording with the arm's poses, or a cloud made from one",
            )
        if arm is not None:
            raise OptionError("a cloud in Base takes no arm", where="--arm", remedy="leave it out")
        return Measured(cloud), cloud.is_simulated, found.remarks
    source = read_recording(scan, None if arm is None else read_arm_model(arm))
    calibration = read_scanner_calibration(scanner)
    measured = measure_scan(source, calibration, ScanOptions(has_normals=False), progress=progress)
    warnings = (*source.warnings, *source.session.assumed, *measured.warnings)
    measured = replace(measured, warnings=warnings)
    return Measured(measured.cloud, measured, calibration), source.is_simulated, ()


def _of_scanner(cloud: PointCloud, path: Path, scanner: Path | None) -> tuple[str, ...]:
    """What is not known of whether a cloud was measured with the scanner given, in words."""
    if scanner is None:
        return ()
    own = read_scanner_calibration(scanner).provenance.document_id
    named = [mark.document_id for mark in cloud.calibrations]
    if not named:
        return (
            "the cloud does not say which calibration it was measured with: that it was "
            f"{scanner.name} is taken from you",
        )
    if own not in named:
        raise InputError(
            f"the cloud was measured with the calibration {', '.join(named)}, and {scanner.name} "
            f"is {own}",
            where=path_text(path),
            remedy="give the document that it was measured with, or reconstruct it with this one",
        )
    if len(named) > 1:
        return (f"the cloud was measured with {len(named)} calibrations, not with this one alone",)
    return ()


def _verified(
    measured: Measured,
    standard: Standard,
    region: Box | None,
    options: VerifyOptions,
    inspection: InspectionOptions,
) -> Verification:
    if standard.ball_mm is not None:
        diameter = standard.ball_mm
        return verify_on_ball(measured, diameter, options, region=region, inspection=inspection)
    middle = measured.cloud.points_mm.mean(axis=0)
    plate, weak = _plate(standard, middle, _tool_places(measured))
    found = verify_on_plate(measured, plate, options, region=region, inspection=inspection)
    return replace(found, warnings=(*weak, *found.warnings))


def _plate(
    standard: Standard, middle_mm: FloatArray, towards_mm: FloatArray | None
) -> tuple[PlateReference, tuple[str, ...]]:
    """The plate, and what is weak about it; ``middle_mm`` (3,) is that of the scanned points."""
    if standard.plate is not None:
        return read_plate(standard.plate, middle_mm, towards_mm=towards_mm, side=standard.side)
    plane = plane_from_coefficients(parse_plane(standard.plane, "--plane"), middle_mm)
    return PlateReference(plane=plane), ()


def _tool_places(measured: Measured) -> FloatArray | None:
    """(M, 3) places of the arm's tool; None where not known."""
    if measured.scan is None:
        return None
    poses = measured.scan.poses
    found = poses.translations_mm[poses.has_pose]
    return found if len(found) else None


def _report(name: str, result: Verification, measured: Measured) -> InspectionReport:
    found, cloud = result.found, measured.cloud
    if isinstance(found, SphereInspection):
        base = sphere_report(found, cloud)
    else:
        base = plane_report(found, cloud)
    of_scan = () if measured.scan is None else measured.scan.warnings
    cards = [
        fact(
            check.name.capitalize(),
            f"E {_value(check, check.error)}",
            f"limit {_value(check, check.limit)}: {check.verdict}",
        )
        for check in result.checks
    ]
    verdict = fact("Verdict", result.verdict, ADVICE[result.verdict])
    return replace(
        base,
        title=f"Scanner verified: {result.verdict}",
        subtitle=f"{name}: {base.subtitle}",
        cards=(verdict, *cards, *only(base.quantities, "points.n_feature")),
        warnings=(*result.warnings, *of_scan, *base.warnings),
    )


def _check_data(check: Check) -> dict[str, object]:
    return {
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


def _checks_table(checks: tuple[Check, ...]) -> Table:
    """Every check with its limit and verdict."""
    heads = ("check", "error E", "predicted spread", "limit MPE", "uncertainty U", "verdict")
    rows = tuple(
        (
            check.name,
            *(
                _value(check, value)
                for value in (check.error, check.predicted, check.limit, check.uncertainty)
            ),
            check.verdict,
        )
        for check in checks
    )
    return Table(heads, rows, "", (5,))


def _definitions_table(checks: tuple[Check, ...]) -> Table:
    """What the numbers of the checks are."""
    rows = tuple(
        (check.name, check.definition, check.limit_rule, check.uncertainty_rule) for check in checks
    )
    return Table(("check", "E is", "MPE is", "U holds"), rows, "", (1, 2, 3))


def _value(check: Check, value: float) -> str:
    return significant(value, check.unit, 2)
