# SPDX-License-Identifier: Apache-2.0
"""Which channel of a set of colour photographs shows the stripe best, weighed over the whole set.

One photograph does not tell: a lamp, a red handle, the pattern of the board and JPEG's coarse
colours each win somewhere. Over a set the laser's line is the one that is long, straight on the
board, narrow, and on the light sheet on which the boards agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from armscan.calibration.laser.calibrate import sight_on_boards
from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.options import SheetOptions
from armscan.calibration.laser.result import BoardStripes
from armscan.calibration.laser.sightings import BoardImage
from armscan.geometry.arrays import IntArray
from armscan.vision.stripe.options import LaserColour

SAMPLE = 8
"""Photographs on which every channel is tried, evenly spread over the set."""
FIRST = 3
"""After so many of them, channels that show next to nothing are given up."""
NEXT_TO_NOTHING = 0.1
LEAST_SCATTER_PX = 0.1
"""Scatter below this does not make a channel better: boards and lens are not known better."""
CHANNELS: tuple[LaserColour, ...] = get_args(LaserColour)[1:]


@dataclass(frozen=True, slots=True)
class ChannelEvidence:
    """What one channel showed in the sample.

    Parameters
    ----------
    channel
        Its name.
    n_images
        Photographs with a stripe on the common sheet.
    n_points
        Points of these stripes.
    scatter_px
        Root mean square, over the photographs, of the points' scatter about their straight stripe.
    weight
        Points over the square of their scatter, summed: the precision that the set gets from it.
    """

    channel: LaserColour
    n_images: int
    n_points: int
    scatter_px: float
    weight: float


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """The channel taken for a set, and the evidence of all, the best first."""

    channel: LaserColour
    n_sampled: int
    evidence: tuple[ChannelEvidence, ...]

    @property
    def reason(self) -> str:
        """Why it was taken, in words."""
        best, *others = self.evidence
        text = (
            f"{best.channel}: the stripe on the common sheet in {best.n_images} of "
            f"{self.n_sampled} sampled photographs, {best.n_points} points that scatter "
            f"{best.scatter_px:.2f} px"
        )
        if others and others[0].weight > 0.0:
            rival = others[0]
            text += (
                f"; next {rival.channel} with {rival.n_images}, {rival.n_points} and "
                f"{rival.scatter_px:.2f} px"
            )
        return text


def choose_channel(
    n_images: int,
    stripes_of: Callable[[int, LaserColour], BoardStripes | None],
    cameras: HeadCameras,
    options: SheetOptions,
) -> ChannelChoice | None:
    """Try every channel on a sample of a set and take the one with the most evidence.

    Parameters
    ----------
    n_images
        Photographs with a board.
    stripes_of
        The stripes of a photograph in a channel; None where there is none.
    cameras
        The cameras.
    options
        Of the light sheets.

    Returns
    -------
    ChannelChoice or None
        None where no channel shows a straight stripe on a board.
    """
    sample = np.unique(np.linspace(0, n_images - 1, min(SAMPLE, n_images)).round().astype(int))
    # The middle one and both ends first: they differ most.
    order = sorted(
        range(len(sample)), key=lambda k: k not in {0, len(sample) // 2, len(sample) - 1}
    )
    found: dict[LaserColour, list[BoardStripes]] = {channel: [] for channel in CHANNELS}
    open_channels = list(CHANNELS)
    for tried, k in enumerate(order):
        for channel in open_channels:
            stripes = stripes_of(int(sample[k]), channel)
            if stripes is not None:
                found[channel].append(stripes)
        if tried == FIRST - 1 and len(order) > FIRST:
            evidence = [_weigh(c, found[c], cameras, options) for c in open_channels]
            best = max(item.weight for item in evidence)
            open_channels = [
                item.channel for item in evidence if item.weight >= NEXT_TO_NOTHING * best
            ]
    evidence = [_weigh(channel, found[channel], cameras, options) for channel in open_channels]
    evidence.sort(key=lambda item: -item.weight)
    if not evidence or evidence[0].weight <= 0.0:
        return None
    return ChannelChoice(evidence[0].channel, len(sample), tuple(evidence))


def _weigh(
    channel: LaserColour,
    boards: Sequence[BoardStripes],
    cameras: HeadCameras,
    options: SheetOptions,
) -> ChannelEvidence:
    images = sight_on_boards(boards, cameras, options).images if boards else ()
    counts, squares = [], []
    for image in images:
        for sighting in image.sightings:
            counts.append(len(sighting.rows))
            squares.append(_scatter_px(image, sighting.rows) ** 2)
    n, square = np.array(counts, dtype=np.int64), np.array(squares)
    weight = float((n / (square + LEAST_SCATTER_PX**2)).sum())
    scatter = float(np.sqrt((n * square).sum() / n.sum())) if len(n) else 0.0
    n_shown = sum(1 for image in images if image.sightings)
    return ChannelEvidence(channel, n_shown, int(n.sum()), scatter, weight)


def _scatter_px(image: BoardImage, rows: IntArray) -> float:
    """Robust scatter of a stripe's points across a straight line on the board, in pixels."""
    pose = image.placed.sensor_from_board
    flat = ((image.points.points_mm[rows] - pose.translation_mm) @ pose.rotation)[:, :2]
    centred = flat - flat.mean(axis=0)
    along, across = np.linalg.svd(centred, full_matrices=False)[2]
    x, y = centred @ along, centred @ across
    missed = y - np.polyval(np.polyfit(x, y, 1), x)
    mm_px = float(np.median(image.sigma_mm[rows] / image.data.profile.sigma_px[rows]))
    return 1.4826 * float(np.median(np.abs(missed))) / mm_px
