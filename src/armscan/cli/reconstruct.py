# SPDX-License-Identifier: Apache-2.0
"""``armscan reconstruct`` and ``fuse``: from images to points, and to one point a voxel."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import Work, job_command
from armscan.cli.options import (
    ArmFile,
    BackgroundImages,
    BitsAlign,
    BitsUsed,
    EulerAngles,
    LaserColourOption,
    Method,
    MethodOption,
    StripeMethodOption,
    given,
    refuse_given,
    refuse_vain,
)

EXIT_INPUT = 2
OF_IMAGES = (
    "background right right_background sheet depth_margin arm "
    "method stripe_method laser_colour bits_used bits_align cache profile cluster"
)
RECONSTRUCT_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan reconstruct scan --scanner scanner.json -o cloud.ply\n"
    "  armscan reconstruct scan/laser.png --background scan/dark.png --sensor sensor.json \\\n"
    "      --sheet A -o cloud.ply\n"
    "  armscan reconstruct left.png --right right.png --sensor sensor.json -o cloud.ply\n"
    "  armscan reconstruct scan --scanner scanner.json --voxel 0.2 -o thin.ply\n"
    "  armscan reconstruct week --scanner scanner.json -o clouds\n"
    "  armscan reconstruct 'p*.yml' --poses RobPoses.rob --scanner scanner.json -o cloud.ply"
)
FUSE_EXAMPLE = "\b\nExample:\n  armscan fuse monday.ply tuesday.ply --voxel 0.2 -o fused.ply"

DepthMargin = Annotated[
    float | None,
    typer.Option(
        help="Widen the calibrated depth range by this part of its width at either end; "
        "points beyond are left out. Without it 0; with two cameras 0.5; points between are "
        "extrapolated.",
        show_default=False,
    ),
]
ProfilePoses = Annotated[
    Path | None,
    typer.Option(
        help="Table of the robot's poses, one a profile: the files are profiles of a sensor "
        "that delivers points.",
        show_default=False,
    ),
]


Images = Annotated[
    list[str],
    typer.Argument(
        help="A recording, folder or .mcap; a folder of recordings; or images with the laser on: "
        "files, folders, patterns.",
        show_default=False,
    ),
]
Calibration = Annotated[
    Path,
    typer.Option(
        "--sensor",
        "--scanner",
        help="Calibration: a recording with scanner.json is placed in Base, all else is in the "
        "Sensor frame.",
        show_default=False,
    ),
]
ProfileOption = Annotated[
    bool, typer.Option("--profile", help="Say what each stage of a scan took.")
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        help="Dask scheduler, tcp://HOST:PORT, whose workers extract the stripes of a scan.",
        show_default=False,
    ),
]
VoxelOption = Annotated[
    float | None,
    typer.Option(
        "--voxel",
        help="Thin the cloud in Base to one point a voxel of this edge, mm, as `fuse` does.",
        show_default=False,
    ),
]
Volume = Annotated[
    str, typer.Option(help="Part of Base to measure: xmin,xmax,ymin,ymax,zmin,zmax in mm.")
]

CloudsPlace = Annotated[
    Path,
    typer.Option(
        "-o", "--output", help="Cloud to write: .ply, or as `convert`; a folder for many."
    ),
]
CloudFile = Annotated[
    Path, typer.Option("-o", "--output", help="Cloud to write: .ply, or as `convert`.")
]


@job_command(
    CloudsPlace, Path("cloud.ply"), also="cache force",
    code=lambda said: EXIT_INPUT if said.extra.get("n_failed") else 0,
)  # fmt: skip
def reconstruct(
    context: typer.Context,
    *,
    images: Images,
    sensor: Calibration,
    background: BackgroundImages = None,
    right: Annotated[
        list[str] | None,
        typer.Option(help="Right camera's images of the same instants; of a stereo head."),
    ] = None,
    right_background: Annotated[
        list[str] | None, typer.Option(help="The right camera's without laser; repeatable.")
    ] = None,
    sheet: Annotated[str, typer.Option(help="Sheet that drew the stripes; empty finds it.")] = "",
    depth_margin: DepthMargin = None,
    volume: Volume = "",
    voxel: VoxelOption = None,
    arm: ArmFile = None,
    poses: ProfilePoses = None,
    euler: EulerAngles = None,
    method: MethodOption = None,
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
    profile: ProfileOption = False,
    cluster: ClusterOption = None,
) -> Work:
    """Measure points from recordings of scans, or from images."""
    from armscan.jobs.reconstruct import PoseTable, StillPaths
    from armscan.jobs.reconstruct import reconstruct as reconstruct_points
    from armscan.pipeline.cluster.extraction import ClusterAddress
    from armscan.pipeline.measure import MeasureOptions
    from armscan.reconstruction.triangulate import DepthRange
    from armscan.storage.images import ImageOptions
    from armscan.vision.stripe.image import StripeOptions

    names = (images, background, right, right_background)
    if poses is None:
        refuse_vain({"--euler": euler}, "there is no table of poses", "give --poses, or leave out")
    else:
        refuse_given(
            context, OF_IMAGES, "profiles with --poses are points already: no image is read"
        )
    options = MeasureOptions(
        stripes=given(StripeOptions, method=stripe_method, laser_colour=laser_colour),
        depths=None if depth_margin is None else DepthRange(depth_margin),
        sheet=sheet,
        is_by_thesis=method is Method.THESIS,
    )
    return lambda job: reconstruct_points(
        job,
        sensor,
        StillPaths(*(tuple(one or ()) for one in names)),
        volume=volume,
        arm=arm,
        poses=None if poses is None else given(PoseTable, path=poses, euler=euler),
        options=options,
        image_options=given(ImageOptions, bits_used=bits_used, align=bits_align),
        is_profiled=profile,
        cluster=None if cluster is None else ClusterAddress(cluster),
        voxel_mm=voxel,
        tell=lambda line: typer.echo(line, err=True),
    )


@job_command(CloudFile, Path("fused.ply"))
def fuse(
    clouds: Annotated[
        list[Path],
        typer.Argument(help="Clouds in one frame, as `convert` reads them.", show_default=False),
    ],
    *,
    voxel: Annotated[
        float, typer.Option("--voxel", help="Edge of a voxel, mm.", show_default=False)
    ],
) -> Work:
    """Thin clouds to one point a voxel.

    Points are averaged by weight, with what is left of their sigma.
    """
    from armscan.jobs.fuse import fuse as fuse_clouds

    return lambda job: fuse_clouds(job, clouds, voxel)
