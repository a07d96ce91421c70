# SPDX-License-Identifier: Apache-2.0
"""From a cloud to a feature, or to how two features stand, and the page about it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from armscan.errors import OptionError
from armscan.geometry.arrays import Box
from armscan.geometry.features import SHAPE_KINDS
from armscan.inspection.features import inspect_feature as feature_of
from armscan.inspection.features import relate
from armscan.inspection.search import WantedFeature
from armscan.inspection.selection import InspectionOptions
from armscan.jobs.inspection.shapes import finished_inspection
from armscan.jobs.job import Job, solved
from armscan.report.inspection.features import feature_report, relation_report
from armscan.report.quantity import Summary
from armscan.storage.clouds import read_cloud

WORDS = {
    "diameter": "diameter_mm",
    "range": "diameter_range_mm",
    "half-angle": "half_angle_deg",
    "axis": "axis",
    "seed": "seed_mm",
    "region": "region",
}
"""What a description of a feature may say, and which field of `WantedFeature` it sets."""


def inspect_feature(
    job: Job, path: Path, wanted: WantedFeature, *, options: InspectionOptions | None = None
) -> Summary:
    """Inspect one feature of a cloud.

    Parameters
    ----------
    job
        Where to write the page, if anywhere.
    path
        A cloud in any format that is read.
    wanted
        What is looked for.
    options
        Which points belong to it.

    Raises
    ------
    ArmscanError
        If the file is unreadable, an option is wrong, or there is no such feature.
    """
    options = options or InspectionOptions()
    job.places(".html")
    cloud = read_cloud(path)
    found = solved(feature_of(cloud, wanted, options), path)
    return finished_inspection(job, cloud, feature_report(found, cloud), (path,), (options, wanted))


def inspect_relation(
    job: Job,
    path: Path,
    first: WantedFeature,
    second: WantedFeature,
    *,
    options: InspectionOptions | None = None,
) -> Summary:
    """Inspect how two features of a cloud stand to each other; the rest as `inspect_feature`."""
    options = options or InspectionOptions()
    job.places(".html")
    cloud = read_cloud(path)
    both = [solved(feature_of(cloud, wanted, options), path) for wanted in (first, second)]
    report = relation_report(relate(cloud, both[0], both[1]), cloud)
    return finished_inspection(job, cloud, report, (path,), (options, first, second))


def parse_feature(text: str, where: str) -> WantedFeature:
    """The feature of a description such as ``cylinder:diameter=20:seed=1,2,3``.

    Raises
    ------
    OptionError
        If it is not understood.
    """
    kind, *parts = text.split(":")
    words = ", ".join(WORDS)
    remedy = f"write KIND:WORD=VALUE:..., as cylinder:diameter=20:seed=1,2,3; words are {words}"
    if kind not in SHAPE_KINDS:
        what = f"there is no feature '{kind}'"
        raise OptionError(what, where=where, remedy=f"give one of {', '.join(SHAPE_KINDS)}")
    given: dict[str, object] = {}
    for part in parts:
        word, is_there, value = part.partition("=")
        if word not in WORDS or not is_there:
            raise OptionError(f"'{part}' is not understood", where=where, remedy=remedy)
        try:
            numbers = tuple(float(item) for item in value.split(","))
        except ValueError as error:
            raise OptionError(f"'{part}' holds no numbers", where=where, remedy=remedy) from error
        given[WORDS[word]] = numbers
    return wanted_feature(kind, where, given)


def wanted_feature(kind: str, where: str, given: dict[str, object]) -> WantedFeature:
    """A feature of values that are numbers, or tuples of them, by field; None for not given.

    Raises
    ------
    OptionError
        If one of them is wrong.
    """
    values = {name: value for name, value in given.items() if value not in (None, ())}
    for name, value in values.items():
        single = name in ("diameter_mm", "half_angle_deg")
        if isinstance(value, tuple) and single:
            if len(value) != 1:
                raise OptionError(f"{len(value)} numbers for one", where=where, remedy="give one")
            values[name] = value[0]
        elif name == "region" and isinstance(value, tuple):
            values[name] = Box.from_limits(value, where)
        elif name == "diameter_range_mm" and isinstance(value, tuple) and len(value) != 2:
            raise OptionError(
                f"{len(value)} numbers where 2 are needed", where=where, remedy="give least,largest"
            )
    known = {item.name for item in fields(WantedFeature)}
    try:
        return WantedFeature(kind=kind, **{k: v for k, v in values.items() if k in known})  # type: ignore[arg-type]
    except OptionError as error:
        raise OptionError(error.what, where=where, remedy=error.remedy) from error
