# SPDX-License-Identifier: Apache-2.0
"""The board in every image of a calibration of light sheets: found once a placement and camera.

Images that saw the board in one place share its pose: those of one view of a recording, whatever
laser was on and whichever camera took them, and those with one image without laser.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.board_pose import estimate_board_pose
from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.result import PlacedBoard
from armscan.calibration.laser.second_view import place_board, poses_chi2
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.pipeline.cached_detection import cached_target
from armscan.pipeline.exposure_pairs import ExposurePair
from armscan.records.exposure import Exposure
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.targets.circle_centres import correct_centres
from armscan.vision.targets.definition import Target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.symmetry import numberings, renumbered
from armscan.vision.targets.view import TargetView

LARGEST_CHI2 = 900.0
"""Two cameras whose poses of one board differ by more, of 6 expected, did not see one placement:
30 sigma leave room for a board that is not quite flat."""

SeenBoard = tuple[int, TargetView, Estimate[Pose[Sensor, Board]]]
"""Camera, target, and the board's pose in the camera's own frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """One place of the board.

    Parameters
    ----------
    name
        Of the view, or of the image in which the board was looked for.
    seen
        What each camera saw, by its number; a failure where it found no board.
    placed
        The pose in Sensor from all of them; None where no camera found the board.
    """

    name: str
    seen: dict[int, SeenBoard | FitFailure]
    placed: PlacedBoard | None


def placement_of(pair: ExposurePair) -> str:
    """Name of the placement that a pair shows."""
    exposure, background = pair
    return exposure.view or (exposure if background is None else background).source


def find_placements(
    pairs: Sequence[ExposurePair],
    target: Target,
    cameras: HeadCameras,
    options: TargetOptions,
    cache: DetectionCache | None = None,
) -> Iterator[Placement]:
    """Look for the board in each placement, one after the other; ``cache`` knows earlier finds.

    The images without laser are tried first.
    """
    groups: dict[str, dict[int, list[Exposure]]] = {}
    for name, tried in (
        *((placement_of(pair), pair[1]) for pair in pairs if pair[1] is not None),
        *((placement_of(pair), pair[0]) for pair in pairs),
    ):
        images = groups.setdefault(name, {}).setdefault(tried.camera, [])
        if all(tried is not image for image in images):
            images.append(tried)
    for name, by_camera in groups.items():
        seen = {
            camera: _see(camera, images, target, cameras, options, cache=cache)
            for camera, images in sorted(by_camera.items())
        }
        yield _placed(name, seen, target, cameras)


def _see(
    camera: int,
    images: Sequence[Exposure],
    target: Target,
    cameras: HeadCameras,
    options: TargetOptions,
    *,
    cache: DetectionCache | None,
) -> SeenBoard | FitFailure:
    """The board in the first image that shows it, or why the first does not."""
    failures: list[FitFailure] = []
    for image in images:
        view = cached_target(image, target, options, cache)
        found = view if isinstance(view, FitFailure) else _posed(camera, view, cameras)
        if not isinstance(found, FitFailure):
            return found
        failures.append(found)
    return failures[0] if failures else FitFailure("there is no image of it", "give one")


def _posed(camera: int, view: TargetView, cameras: HeadCameras) -> SeenBoard | FitFailure:
    model = cameras.model(camera)
    if view.edges is not None:
        view = correct_centres(view, model)
    pose = estimate_board_pose(view, model)
    return pose if isinstance(pose, FitFailure) else (camera, view, pose)


def _placed(
    name: str, seen: dict[int, SeenBoard | FitFailure], target: Target, cameras: HeadCameras
) -> Placement:
    found = {camera: item for camera, item in seen.items() if not isinstance(item, FitFailure)}
    if not found:
        return Placement(name, seen, None)
    if len(found) == 1:
        return Placement(name, seen, place_board(tuple(found.values()), cameras))
    left, right = found[0], _numbered_alike(found[0], found[1], target, cameras)
    if isinstance(right, FitFailure):
        return Placement(name, {**seen, 1: right}, place_board((left,), cameras))
    chi2 = poses_chi2(left, right, cameras)
    if chi2 > LARGEST_CHI2:
        failure = FitFailure(
            f"the cameras see the board in different places (chi2 {chi2:.3g} of 6 expected)",
            "check that the images are of one instant, and the stereo calibration",
        )
        return Placement(name, {**seen, 1: failure}, place_board((left,), cameras))
    return Placement(name, {**seen, 1: right}, place_board((left, right), cameras))


def _numbered_alike(
    left: SeenBoard, right: SeenBoard, target: Target, cameras: HeadCameras
) -> SeenBoard | FitFailure:
    """The right camera's board with the numbers of the left one's.

    A symmetric target may be numbered from either end; the poses tell which.
    """
    turn = cameras.right().right_from_sensor.rotation
    here = turn @ left[2].value.rotation
    there = right[2].value.rotation
    best = max(
        numberings(target),
        key=lambda n: float(np.trace(here.T @ there @ n.new_from_found.rotation.T)),
    )
    if best.quarter_turns == 0:
        return right
    return _posed(1, renumbered(right[1], target, best), cameras)
