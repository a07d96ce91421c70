# SPDX-License-Identifier: Apache-2.0
"""Charts of measured points."""

from __future__ import annotations

import numpy as np

from armscan.models.calibration import SensorCalibration
from armscan.records.cloud import PointCloud
from armscan.report.drawing import ACCENT, PALETTE, chart_markup, new_figure, raster_markup, styled
from armscan.report.numbers import significant
from armscan.report.page import Picture
from armscan.report.scene import SceneDots, ramp_colours, ramp_markup, scene_markup

MAX_SHOWN = 20_000


def cloud_view(cloud: PointCloud) -> Picture:
    """The points in space, coloured by their standard deviation."""
    step = max(1, len(cloud) // MAX_SHOWN)
    sigma_um = 1000.0 * cloud.sigma_mm[::step]
    low, high = (float(value) for value in np.percentile(sigma_um, [2, 98]))
    dots = SceneDots(cloud.points_mm[::step], ramp_colours(sigma_um, low, high))
    is_z_up = cloud.frame != "Sensor"
    scene = scene_markup([dots], [], [], "Measured points in space", is_z_up=is_z_up)
    shown = f" One point in {step} is shown." if step > 1 else ""
    return Picture(
        ramp_markup(f"sigma {significant(low)} µm", f"{significant(high)} µm") + scene,
        title=f"Points in space ({cloud.frame} frame)",
        caption="Colour is each point's standard deviation along its worst direction, "
        f"{'stripe noise, arm' if is_z_up else 'stripe noise'} and calibration together. "
        "Drag to turn; click, then scroll to zoom." + shown,
    )


def profile_view(cloud: PointCloud, sensor: SensorCalibration, exposure: int) -> Picture:
    """The points of one exposure in the plane of their sheet."""
    with styled():
        figure = new_figure(6.0, 3.6)
        axes = figure.add_subplot()
        for k, calibration in enumerate(sensor.sheets):
            name = calibration.name
            if name not in cloud.sheet_names:
                continue
            chosen = (cloud.exposure == exposure) & (cloud.sheet == cloud.sheet_names.index(name))
            if not chosen.any():
                continue
            sheet = calibration.sheet
            along, depth = ((cloud.points_mm[chosen] - sheet.origin_mm) @ sheet.axes[:2].T).T
            if sheet.axes[1][2] < 0.0:
                depth = -depth
            colour = PALETTE[k % len(PALETTE)]
            axes.plot(along, depth, ".", markersize=1.8, color=colour, label=f"sheet {name}")
        axes.set_xlabel("along the stripe, mm")
        axes.set_ylabel("depth in the sheet, mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.grid()
        axes.legend(markerscale=5)
    return Picture(
        raster_markup(figure, "Profile in the sheet"),
        title=cloud.exposure_sources[exposure],
    )


def sigma_histogram(cloud: PointCloud) -> Picture:
    """How uncertain the points are, and how much of it is stripe noise."""
    sigma_um = 1000.0 * cloud.sigma_mm
    noise_um = 1000.0 * cloud.sigma_noise_mm
    edges = np.linspace(0.0, 1.15 * float(np.percentile(sigma_um, 99)), 61).tolist()
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(sigma_um, edges, color=ACCENT, label="all")
        axes.hist(
            noise_um, edges, histtype="step", color=PALETTE[1], linewidth=1.4, label="stripe noise"
        )
        axes.set_xlabel("standard deviation of a point, µm")
        axes.set_ylabel("points")
        axes.legend()
    return Picture(
        chart_markup(figure, "Histogram of the points' standard deviations"),
        title="How far to trust a point",
        caption="Stripe noise differs from point to point and averages out; the rest, from the "
        "calibration, moves neighbouring points together and does not.",
    )
