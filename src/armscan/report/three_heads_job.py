# SPDX-License-Identifier: Apache-2.0
"""The demo of all three heads: each in its own folder, and a page that compares them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from armscan.errors import OutputError
from armscan.pipeline.progress import Progress, silent
from armscan.report.demo_folder import check_demo_folder
from armscan.report.head_demo_job import TRUTH, HeadDemoRequest, make_head_demo
from armscan.report.origin import footer
from armscan.report.page import render_page
from armscan.report.summary import Summary, summary_json
from armscan.report.three_heads_page import (
    HeadPicture,
    head_picture,
    kind,
    three_heads_page,
    three_heads_table,
)
from armscan.storage.atomic import write_files
from armscan.storage.provenance import new_provenance

HEADS = ("thesis-single", "thesis-cross", "thesis-multi")
FOLDERS = {name: name.removeprefix("thesis-") for name in HEADS}
PAGE, DATA = "report.html", "summary.json"


def run_three_heads(request: HeadDemoRequest, progress: Progress = silent) -> Summary:
    """Run the demo of each head, and compare them.

    An earlier comparison is removed first: if a head fails, none stands beside heads that it does
    not compare.

    Parameters
    ----------
    request
        As for one head; each gets a folder of its name in the request's.
    progress
        Told of every exposure.

    Raises
    ------
    ArmscanError
        If the folder holds something else than an earlier demo or cannot be written.
    """
    folder = request.folder
    mark = folder / FOLDERS[HEADS[0]] / TRUTH
    check_demo_folder(folder, {*FOLDERS.values(), PAGE, DATA}, mark)
    _remove_comparison(folder)
    heads: dict[str, Any] = {}
    pictures: dict[str, HeadPicture] = {}
    warnings: list[str] = []
    for name in HEADS:
        own = replace(request, folder=folder / FOLDERS[name], head=name)
        summary, demo = make_head_demo(own, progress)
        heads.update(summary.data["heads"])
        pictures[name] = head_picture(kind(name), demo)
        warnings += [f"{kind(name)}: {text}" for text in summary.warnings]
    command = ("armscan", "demo", "all", "-o", folder.as_posix())
    options = ("--preset", request.preset, "--seed", str(request.seed))
    truths = [folder / FOLDERS[name] / TRUTH for name in HEADS]
    provenance = new_provenance(truths, command=(*command, *options))
    page = three_heads_page(heads, pictures, footer(provenance))
    first = summary.data
    result = Summary(
        title="Demo of three simulated heads on the same scenes",
        facts=(),
        tables=(three_heads_table(heads),),
        warnings=tuple(warnings),
        written=_written(folder),
        next_step=f"open {folder / PAGE} in a browser; each head has its own page in its folder",
        data={**{key: first[key] for key in first if key != "heads"}, "heads": heads},
    )
    files = {folder / PAGE: render_page(page), folder / DATA: summary_json(result).encode()}
    write_files(files, is_overwriting=True)
    return result


def _remove_comparison(folder: Path) -> None:
    for name in (PAGE, DATA):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"the earlier comparison cannot be removed ({error.strerror or error})",
                where=str(folder / name),
                remedy="choose another folder",
            ) from error


def _written(folder: Path) -> tuple[Path, ...]:
    return (*(folder / own for own in FOLDERS.values()), folder / PAGE, folder / DATA)
