# SPDX-License-Identifier: Apache-2.0
"""``armscan probe``, ``stripes``, ``markers``, ``register``: touches, and what images show."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import Work, job_command
from armscan.cli.options import (
    BackgroundImages,
    BitsAlign,
    BitsUsed,
    DefaultOf,
    LaserColourOption,
    Method,
    MethodOption,
    Side,
    StripeMethodOption,
    given,
    refuse_vain,
)

PROBE_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan probe touches/ -o plate.csv\n"
    "  armscan probe centres.csv --side +x -o plate.csv"
)
STRIPES_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan stripes 'photos/*.png'\n"
    "  armscan stripes on/ --background off/ --laser-colour green -o lines.csv"
)
MARKERS_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan markers 'photos/*.png' -o rings.html\n"
    "  armscan markers left.png right.png --stereo stereo.json --diameter 6 -o markers.csv"
)
REGISTER_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan register views/view1.csv views/view2.csv views/view3.csv -o joined\n"
    "  armscan register before.csv --moved after.csv --cloud after.ply -o joined"
)
RINGS = "armscan.vision.rings:RingOptions."
RIM = "Of the outer rim, untilted, px."
LeastPerimeter = Annotated[
    float | None,
    typer.Option(help=RIM, show_default=DefaultOf(RINGS + "min_perimeter_px")),
]
MostPerimeter = Annotated[
    float | None,
    typer.Option(help=RIM, show_default=DefaultOf(RINGS + "max_perimeter_px")),
]
Roundness = Annotated[
    float | None,
    typer.Option(
        help="Long over short axis; 1.7 is a tilt of 54 degrees.",
        show_default=DefaultOf(RINGS + "max_roundness"),
    ),
]
Disc = Annotated[
    str | None,
    typer.Option(help="light (in a dark ring) or dark.", show_default=DefaultOf(RINGS + "disc")),
]

TouchedPoints = Annotated[
    Path | None,
    typer.Option("-o", "--output", help="Points on the surface, a CSV table.", show_default=False),
]
StripeFile = Annotated[
    Path | None, typer.Option("-o", "--output", help="Table NAME.csv, with a page beside it.")
]
MarkerFile = Annotated[
    Path | None,
    typer.Option(
        "-o", "--output", help="Page NAME.html; with --stereo the table NAME.csv and a page."
    ),
]
RegisteredFolder = Annotated[
    Path,
    typer.Option("-o", "--output", help="New folder for clouds, registration.json and page."),
]


@job_command(TouchedPoints, None)
def probe(
    touches: Annotated[
        Path,
        typer.Argument(
            help="Folder with arm.csv (a row a touch) and probe.toml; or a table of points.",
            show_default=False,
        ),
    ],
    *,
    side: Annotated[
        Side | None,
        typer.Option(
            help="Axis that the plate's face looks along; default: to where the tool was.",
            show_default=False,
        ),
    ] = None,
    probe: Annotated[
        Path | None,
        typer.Option(help="The tip, if it is not probe.toml of the folder.", show_default=False),
    ] = None,
    feature: Annotated[
        str, typer.Option(help="Feature to use, where the table names several.", show_default=False)
    ] = "",
    leave_out: Annotated[
        bool, typer.Option("--leave-out", help="Leave out touches that do not fit the others.")
    ] = False,
) -> Work:
    """Fit the plane of a plate to touches.

    The tip's radius is taken off on the side of the probe. A touch that does not fit the others is
    named. In probe.toml: centre_tool_mm = [x, y, z] and tip_diameter_mm = 6.0. A table of tip
    centres says so in its first line:
    # point = tip-centre, tip_diameter_mm = 6
    """
    from armscan.calibration.hand_eye.probed_plate import ProbingOptions
    from armscan.jobs.probe import probe as probe_plate

    options = ProbingOptions(
        side=None if side is None else side.value, leave_out_outliers=leave_out, feature=feature
    )
    return lambda job: probe_plate(job, touches, probe, options)


@job_command(StripeFile, None)
def stripes(
    images: Annotated[
        list[str],
        typer.Argument(help="Image files, folders, or quoted patterns.", show_default=False),
    ],
    *,
    background: BackgroundImages = None,
    laser_colour: LaserColourOption = None,
    stripe_method: StripeMethodOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
) -> Work:
    """Find laser lines in images, without any calibration.

    A first look at photographs: where each line is, how well its centre is known, and why points
    were flagged. Colour images are all looked at in the colour, or the difference of colours, that
    shows most of their lines.
    """
    from armscan.jobs.photographs import find_stripes
    from armscan.storage.images import ImageOptions
    from armscan.vision.stripe.image import StripeOptions

    options = given(StripeOptions, laser_colour=laser_colour, method=stripe_method)
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: find_stripes(job, images, background, stripes=options, image_options=pixels)


@job_command(MarkerFile, None)
def markers(
    *,
    images: Annotated[
        list[str],
        typer.Argument(
            help="Image files, folders, or quoted patterns; with --stereo the left one, then the "
            "right.",
            show_default=False,
        ),
    ],
    stereo: Annotated[
        Path | None, typer.Option(help="Calibration of two cameras: match and triangulate.")
    ] = None,
    diameter: Annotated[
        float | None, typer.Option(help="Outer diameter of the markers, mm; with --stereo.")
    ] = None,
    depth: Annotated[
        str, typer.Option(help="Nearest and farthest depth NEAR:FAR, mm; with --stereo.")
    ] = "",
    min_perimeter: LeastPerimeter = None,
    max_perimeter: MostPerimeter = None,
    max_roundness: Roundness = None,
    disc: Disc = None,
    code: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=A,B,C,D: look for four rings on a line with the cross ratio of these places "
            "(eq. 4.24); repeatable.",
            show_default=False,
        ),
    ] = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
) -> Work:
    """Find ring markers in images.

    With two calibrated cameras, also where they are.
    """
    from armscan.errors import OptionError
    from armscan.jobs.photographs import find_markers, measure_markers
    from armscan.markers.candidates import RingMatchOptions, parse_depth
    from armscan.storage.images import ImageOptions
    from armscan.vision.rings import RingOptions

    rings = given(
        RingOptions,
        min_perimeter_px=min_perimeter,
        max_perimeter_px=max_perimeter,
        max_roundness=max_roundness,
        disc=disc,
    )
    if code and stereo is not None:
        raise OptionError(
            "codes are looked for in single images", where="--code", remedy="leave --stereo out"
        )
    if stereo is None:
        refuse_vain(
            {"--diameter": diameter, "--depth": depth},
            "sizes and depths are of markers that two cameras see",
            "give --stereo, or leave out",
        )
    depth_mm = parse_depth(depth) if depth else None
    matching = given(RingMatchOptions, depth_mm=depth_mm, diameter_mm=diameter)
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: (
        find_markers(job, images, rings=rings, image_options=pixels, codes=code or ())
        if stereo is None
        else measure_markers(
            job, images, stereo, rings=rings, matching=matching, image_options=pixels
        )
    )


@job_command(RegisteredFolder, Path("registered"), also="")
def register(
    lists: Annotated[
        list[Path],
        typer.Argument(
            help="Lists of markers, x_mm,y_mm,z_mm[,id,cov...]: one for each view; with --moved "
            "the one of the old place. The cloud of view1.csv is view1.ply beside it.",
            show_default=False,
        ),
    ],
    *,
    moved: Annotated[
        Path | None,
        typer.Option(
            help="The arm was moved: markers measured from its new place.", show_default=False
        ),
    ] = None,
    cloud: Annotated[
        list[Path] | None,
        typer.Option(
            help="Cloud measured from the new place; repeatable. Without it, the cloud beside "
            "the list.",
            show_default=False,
        ),
    ] = None,
    sigma_mm: Annotated[
        float | None,
        typer.Option(
            "--sigma-mm",
            help="Standard deviation an axis of markers listed without covariance.",
            show_default=DefaultOf("armscan.pipeline.register:RegisterOptions.sigma_mm"),
        ),
    ] = None,
    least_common: Annotated[
        int | None,
        typer.Option(
            "--least-common",
            help="Markers that two lists must share, 4 or more.",
            show_default=DefaultOf("armscan.markers.alignments:MarkerMatchOptions.least_common"),
        ),
    ] = None,
    by_id: Annotated[
        bool,
        typer.Option("--by-id", help="With --moved: equal ids in both lists are one marker."),
    ] = False,
    method: MethodOption = None,
) -> Work:
    """Join scans by ring markers.

    Views of a handheld scanner are joined in the frame of the first one; an arm that was moved to
    a new place goes on in its old frame. Markers carry no numbers: they are recognised by their
    distances, and what fits in more than one way is refused.
    """
    from armscan.jobs.register import register as register_scans
    from armscan.markers.alignments import MarkerMatchOptions
    from armscan.pipeline.register import RegisterOptions

    options = given(
        RegisterOptions,
        match=given(MarkerMatchOptions, least_common=least_common),
        sigma_mm=sigma_mm,
        is_by_id=by_id,
        is_by_thesis=method is Method.THESIS,
    )
    return lambda job: register_scans(job, lists, moved=moved, clouds=cloud or (), options=options)
