# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect cad``, a cloud against its part's model, and ``recipe``, the same for many."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import OF_INSPECTIONS, Work, job_command
from armscan.cli.inspect import EXIT_NOT_PASSED, CloudArgument
from armscan.cli.options import DefaultOf, PageOption, RegionOption, given, numbers

CAD_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan inspect cad cloud.ply part.step --tolerance 0.05 -o part-inspection.html\n\n"
    "\b\nWith a tolerance, exit code 0: every face that was seen passed. 1: one failed or is\n"
    "undecided. 2: the input stood in the way."
)
RECIPE_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan inspect recipe recipe.toml scans/ -o results/\n\n"
    "\b\nExit code 0: every part passed. 1: one failed, is undecided or could not be inspected.\n"
    "2: the recipe is wrong. What is done is kept when it is interrupted, and not done again."
)
PART = "armscan.jobs.inspection.cad:PartOptions."
CAD = "armscan.inspection.cad.comparison:CadOptions."
CHORD = "armscan.storage.parts.step:ChordError."


PartArgument = Annotated[
    Path,
    typer.Argument(
        help="The part's model: .step (extra 'cad'), .stl, .ply or .obj.", show_default=False
    ),
]


class AlignOption(StrEnum):
    """How the cloud is laid on the model."""

    BEST = "best"
    NONE = "none"
    DATUMS = "321"
    FEATURES = "features"
    POINTS = "points"
    MARKERS = "markers"


class UnitOption(StrEnum):
    """Unit of a mesh's numbers."""

    MM = "mm"
    CM = "cm"
    M = "m"
    INCH = "inch"


AlignChoice = Annotated[
    AlignOption | None,
    typer.Option(
        help="best fit without a guess; none: the cloud is in the model's frame; 321: by three "
        "faces, features: by fitted features, one after the other (--datums); points, "
        "markers: by points of known places (--points).",
        show_default=DefaultOf(PART + "align"),
    ),
]
Datums = Annotated[
    str,
    typer.Option(
        help="Faces for 321 and features, 'FACE|FACE|FACE' in their order; for features also "
        "nominal ones, as 'plane 1|cylinder:at=1,2,3:axis=0,0,1:diameter=8'.",
        show_default=False,
    ),
]
Points = Annotated[
    str,
    typer.Option(help="Table of reference points or markers in Cad.", show_default=False),
]
Measured = Annotated[
    str,
    typer.Option(help="Table of the same as measured, in the cloud's frame.", show_default=False),
]
Tolerance = Annotated[
    str,
    typer.Option(
        help="Largest deviation either way, mm; or a .toml or .csv file of tolerances by face.",
        show_default=False,
    ),
]

ResultsFolder = Annotated[
    Path, typer.Option("-o", "--output", help="Folder of the results, new or of earlier ones.")
]


@job_command(
    PageOption, None, also=OF_INSPECTIONS,
    code=lambda said: 0 if said.data.get("verdict", "pass") == "pass" else EXIT_NOT_PASSED,
)  # fmt: skip
def cad(
    cloud: CloudArgument,
    part: PartArgument,
    *,
    align: AlignChoice = None,
    datums: Datums = "",
    points: Points = "",
    measured: Measured = "",
    tolerance: Tolerance = "",
    uncertainty_mm: Annotated[
        float | None,
        typer.Option(
            help="U (k = 2) of a deviation, instead of what the cloud says.", show_default=False
        ),
    ] = None,
    reach_mm: Annotated[
        float | None,
        typer.Option(
            help="Points farther from the model than this are not of the part.",
            show_default=DefaultOf(CAD + "reach_mm"),
        ),
    ] = None,
    unit: Annotated[
        UnitOption | None,
        typer.Option(
            help="Unit of a mesh; STEP says its own.", show_default=DefaultOf(PART + "unit")
        ),
    ] = None,
    chord_mm: Annotated[
        float | None,
        typer.Option(
            help="Triangles of STEP faces lie within this.",
            show_default=DefaultOf(CHORD + "chord_mm"),
        ),
    ] = None,
    region: RegionOption = "",
) -> Work:
    """Judge the deviations of a part from its model by face."""
    from armscan.inspection.cad.comparison import CadOptions
    from armscan.jobs.inspection.cad import PartOptions, inspect_cad
    from armscan.storage.parts.step import ChordError

    box = numbers(region, "--region")
    options = given(CadOptions, reach_mm=reach_mm, uncertainty_mm=uncertainty_mm)
    how = given(
        PartOptions,
        align=None if align is None else align.value,
        unit=None if unit is None else unit.value,
        datums=datums,
        points=points,
        measured=measured,
    )
    chord = None if chord_mm is None else ChordError(chord_mm=chord_mm)
    return lambda job: inspect_cad(
        job,
        cloud,
        part,
        tolerance=tolerance,
        region=box,
        part_options=how,
        options=options,
        chord=chord,
    )


@job_command(ResultsFolder, code=lambda said: 0 if said.data["all_passed"] else EXIT_NOT_PASSED)
def recipe(
    recipe: Annotated[
        Path, typer.Argument(help="What to do with every part (TOML).", show_default=False)
    ],
    clouds: Annotated[
        list[Path],
        typer.Argument(
            help="Clouds of parts, and folders of them, in the order of the trend.",
            show_default=False,
        ),
    ],
) -> Work:
    """Inspect many parts alike, with one table and the trend."""
    from armscan.jobs.inspection.recipe import inspect_recipe

    return lambda job: inspect_recipe(job, recipe, clouds)
