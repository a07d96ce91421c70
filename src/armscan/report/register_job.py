# SPDX-License-Identifier: Apache-2.0
"""From lists of markers and clouds to scans in one frame, and the page that says how well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from armscan.geometry.registration import carried_covariance_mm2
from armscan.models.calibration import Provenance
from armscan.pipeline.carry_cloud import carry_cloud
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.register import PlaceRegistration, register_place, register_views
from armscan.records.markers import MarkerSet
from armscan.report.numbers import sentence
from armscan.report.page import render_page
from armscan.report.register_page import RegisterReport, registration_page
from armscan.report.register_place import place_report
from armscan.report.register_request import (
    NamedCloud,
    RegisterRequest,
    checked,
    cloud_beside,
    common_frame,
    different_names,
    read_lists,
    read_named_cloud,
)
from armscan.report.register_views import map_markers, views_report
from armscan.report.summary import Summary
from armscan.storage.atomic import write_files
from armscan.storage.atomic_folder import check_new_folder, new_folder
from armscan.storage.calibration_bodies import provenance_body
from armscan.storage.calibration_schema import REGISTRATION_SCHEMA
from armscan.storage.clouds import ply_bytes
from armscan.storage.marker_files import MarkerList, markers_csv
from armscan.storage.provenance import new_provenance
from armscan.storage.registration_files import (
    RegistrationDocument,
    registration_document,
)
from armscan.storage.simulated import are_simulated

DOCUMENT, PAGE, MARKERS = "registration.json", "registration.html", "markers.csv"


def run_registration(request: RegisterRequest, progress: Progress = silent) -> Summary:
    """Read the lists, join them, carry the clouds, write the folder and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the markers do not join the scans; nothing
        is written then.
    """
    check_new_folder(request.output)
    request = checked(request)
    if request.moved is None:
        return _join_views(request, progress)
    return _join_place(request, request.moved)


def _join_views(request: RegisterRequest, progress: Progress) -> Summary:
    lists = read_lists(request.lists, "Sensor", request.options)
    names = different_names(request.lists)
    clouds = {
        k: read_named_cloud(path, names[k], item)
        for k, item in enumerate(lists)
        if (path := cloud_beside(item.path)) is not None
    }
    joined = register_views([item.markers for item in lists], request.options, progress)
    frame = common_frame(lists[0])
    carried = [
        replace(
            clouds[view],
            cloud=carry_cloud(
                clouds[view].cloud,
                joined.map.part_from_view[k],
                joined.map.pose_covariance[k],
                frame,
            ),
        )
        for k, view in enumerate(joined.placed)
        if view in clouds
    ]
    report = views_report(lists, names, joined, carried, frame)
    return _written(request, report, lists, carried, map_markers(joined, frame))


def _join_place(request: RegisterRequest, moved: Path) -> Summary:
    old, new = read_lists((request.lists[0], moved), "Base", request.options)
    paths = request.clouds
    if not paths and (beside := cloud_beside(moved)) is not None:
        paths = (beside,)
    named = zip(paths, different_names(paths), strict=True)
    clouds = [read_named_cloud(path, name, new) for path, name in named]
    place = register_place(old, new, request.options)
    frame = common_frame(old)
    carried = [
        replace(item, cloud=carry_cloud(item.cloud, place.fit.value, place.fit.covariance, frame))
        for item in clouds
    ]
    report = place_report(old, new, place, carried)
    return _written(request, report, (old, new), carried, _joint_markers(old, new, place))


def _joint_markers(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> MarkerSet:
    """The old markers, and behind them those that only the new place saw, in the old frame.

    A marker that moved keeps its number and has its new place.
    """
    pose = place.fit.value
    carried = new.markers.points_mm @ pose.rotation.T + pose.translation_mm
    covariance = carried_covariance_mm2(
        new.markers.points_mm, new.markers.covariance_mm2, pose, place.fit.covariance
    )
    points, covariances = old.markers.points_mm.copy(), old.markers.covariance_mm2.copy()
    for item in place.moved:
        i = np.flatnonzero(old.markers.ids == item.old_id)
        k = np.flatnonzero(new.markers.ids == item.new_id)
        points[i], covariances[i] = carried[k], covariance[k]
    added = np.isin(new.markers.ids, place.only_new)
    last = int(old.markers.ids.max())
    return MarkerSet(
        np.concatenate([old.markers.ids, last + 1 + np.arange(int(added.sum()))]),
        np.concatenate([points, carried[added]]),
        np.concatenate([covariances, covariance[added]]),
        old.markers.frame,
    )


def _written(
    request: RegisterRequest,
    report: RegisterReport,
    lists: tuple[MarkerList, ...] | list[MarkerList],
    carried: list[NamedCloud],
    markers: MarkerSet,
) -> Summary:
    inputs = (*(item.path for item in lists), *(item.path for item in carried))
    is_simulated = are_simulated(inputs) or any(item.cloud.is_simulated for item in carried)
    provenance = new_provenance(
        inputs,
        command=request.command,
        options=(request.options,),
        warnings=report.warnings,
        forced=[reason for item in carried for reason in item.cloud.forced],
    )
    page = registration_page(report, provenance, is_simulated=is_simulated)
    contents = {
        DOCUMENT: registration_document(
            _document(request, report, provenance, is_simulated=is_simulated)
        ),
        MARKERS: markers_csv(markers),
        **{item.name: ply_bytes(item.cloud) for item in carried},
        PAGE: render_page(page),
    }
    with new_folder(request.output) as folder:
        write_files({folder / name: content for name, content in contents.items()})
    return Summary(
        title=report.title + (" (simulated data)." if is_simulated else "."),
        facts=report.facts,
        tables=(report.scans,),
        warnings=tuple(sentence(warning) for warning in report.warnings),
        written=tuple(request.output / name for name in contents),
        next_step=f"open {request.output / PAGE}",
        forced=provenance.forced,
        data={
            "kind": "registration",
            "of": "views" if request.moved is None else "moved arm",
            "simulated": is_simulated,
            "common_frame": report.common_frame,
            **report.data,
            "chi2": report.chi2,
            "degrees_of_freedom": report.degrees_of_freedom,
            "transforms": [item.model_dump(mode="json") for item in report.transforms],
            "moved": [item.model_dump(mode="json") for item in report.moved],
        },
    )


def _document(
    request: RegisterRequest, report: RegisterReport, provenance: Provenance, *, is_simulated: bool
) -> RegistrationDocument:
    return RegistrationDocument(
        schema=REGISTRATION_SCHEMA,
        kind="views" if request.moved is None else "moved arm",
        simulated=is_simulated,
        common_frame=report.common_frame,
        common_frame_of=report.common_frame_of,
        transforms=report.transforms,
        residuals=report.residuals,
        moved=report.moved,
        not_joined=report.not_joined,
        chi2=report.chi2,
        degrees_of_freedom=report.degrees_of_freedom,
        provenance=provenance_body(provenance),
    )
