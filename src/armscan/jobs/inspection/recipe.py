# SPDX-License-Identifier: Apache-2.0
"""From clouds of parts and one recipe to a folder a part, a table of all and the trend."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from armscan.errors import ArmscanError, OptionError, OutputError
from armscan.inspection.recipe import FollowedRecipe, PartRow, follow_recipe
from armscan.jobs.inspection.shapes import read_inspected
from armscan.jobs.job import Job, solved
from armscan.pipeline.progress import ProgressEvent
from armscan.report.inspection.cad import cad_page, cad_warnings
from armscan.report.inspection.delivery import require_pdf
from armscan.report.inspection.recipe import (
    part_page,
    parts_table,
    recipe_page,
    recipe_quantities,
)
from armscan.report.page import Page, page_of
from armscan.report.quantity import Summary, sentences
from armscan.storage.clouds import CLOUD_SUFFIXES
from armscan.storage.documents import fingerprint
from armscan.storage.files import Content, is_folder, make_folder, path_text, write_files
from armscan.storage.image_paths import are_simulated, natural_key
from armscan.storage.parts.recipes import (
    PartResult,
    RecipeFile,
    found_features,
    is_part_table,
    part_result_bytes,
    part_table_bytes,
    read_part_result,
    read_recipe,
)
from armscan.storage.parts.tables import deviation_ply_bytes, face_table_bytes

TABLE, INDEX, RESULT = "table.csv", "index.html", "features.json"
INDEX_PDF = "index.pdf"
PART_FILES = (RESULT, "part.html", "part.csv", "part.ply")
PART_PDF = "part.pdf"


@dataclass(frozen=True, slots=True)
class _Run:
    """One recipe over its parts: what holds for each of them."""

    job: Job
    folder: Path
    file: RecipeFile
    hashes: tuple[str, str]

    def row(self, name: str, path: Path) -> PartRow:
        """Inspect one part, or take what was found before from the same files."""
        folder = self.folder / name
        try:
            cloud_hash = fingerprint(path).sha256
            measured = self.file.measured_of(path)
            if measured is not None and measured.is_file():
                cloud_hash += f" {fingerprint(measured).sha256}"
            done = self._done(folder, cloud_hash)
            if done is not None:
                return replace(done, name=name, cloud=path_text(path))
            return self._inspected(name, path, cloud_hash)
        except OutputError:
            raise
        except (ArmscanError, MemoryError, np.linalg.LinAlgError) as error:
            # what an older scan of this name left would be taken for this one's
            for file in (*PART_FILES, PART_PDF):
                (folder / file).unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()
            reason = str(error) or "there is not enough memory"
            if isinstance(error, np.linalg.LinAlgError):
                reason = f"a fit to its points has no solution in numbers ({reason})"
            return PartRow(name, path_text(path), reason=reason)

    def _done(self, folder: Path, cloud_hash: str) -> PartRow | None:
        try:
            found = read_part_result(folder / RESULT)
        except ArmscanError:
            return None
        own = (version("armscan"), *self.hashes, cloud_hash)
        theirs = (
            found.armscan_version, found.recipe_sha256, found.part_sha256, found.cloud_sha256,
        )  # fmt: skip
        is_whole = all((folder / name).is_file() for name in self._names())
        return found.row if own == theirs and is_whole else None

    def _names(self) -> tuple[str, ...]:
        names = PART_FILES if self.file.part is not None else PART_FILES[:2]
        return (*names, PART_PDF) if self.file.has_pdf else names

    def _inspected(self, name: str, path: Path, cloud_hash: str) -> PartRow:
        source = read_inspected(path)
        cloud = source.cloud
        recipe = solved(self.file.for_part(path, cloud.frame), path)
        found = solved(follow_recipe(recipe, cloud), path)
        simulated = cloud.is_simulated or are_simulated((path, *self.file.inputs))
        comparison = found.comparison
        warned = () if comparison is None else cad_warnings(comparison, found.errors_known)
        model = () if self.file.part is None else self.file.part.notes
        cleaned = () if found.cleaning is None else found.cleaning.warnings
        delivery = self.job.delivery(cloud, path)
        row = PartRow(
            name=name,
            cloud=path_text(path),
            quantities=found.quantities,
            notes=sentences(
                (*delivery.warnings, *source.remarks, *found.notes, *cleaned, *model, *warned)
            ),
            is_simulated=simulated,
            forced=cloud.forced,
        )
        result = PartResult(
            version("armscan"), *self.hashes, cloud_hash, row, found_features(found)
        )
        folder = self.folder / name
        folder.mkdir(exist_ok=True)
        contents: dict[Path, Content | Page] = {folder / RESULT: part_result_bytes(result)}
        if comparison is not None and self.file.part is not None:
            contents[folder / "part.csv"] = face_table_bytes(comparison)
            contents[folder / "part.ply"] = deviation_ply_bytes(
                comparison, found.cloud, self.file.part
            )
        page = self._page(found, row, path)
        contents[folder / "part.html"] = delivery.on_page(page)
        self._writer(folder / PART_PDF).write(contents)
        return row

    def _page(self, found: FollowedRecipe, row: PartRow, path: Path) -> Page:
        recipe = self.file.recipe
        cleaning = () if recipe.cleaning is None else (recipe.cleaning,)
        provenance = self.job.provenance(
            (path, *self.file.inputs), (recipe.options, *cleaning),
            warnings=row.notes, forced=row.forced,
        )  # fmt: skip
        if found.comparison is None or self.file.part is None:
            page = page_of(
                provenance, row.name, recipe.title, (), warnings=row.notes,
                is_simulated=row.is_simulated,
            )  # fmt: skip
        else:
            page = cad_page(
                found.comparison, self.file.part, found.cloud, provenance, row.notes,
                is_simulated=row.is_simulated,
            )  # fmt: skip
        return part_page(found, row, replace(page, title=f"{recipe.title}: {row.name}"))

    def write_all(self, rows: Sequence[PartRow]) -> tuple[Path, ...]:
        """Write table and page of the parts that are done; each part's own file names its cloud."""
        forced = tuple(dict.fromkeys(text for row in rows for text in row.forced))
        provenance = self.job.provenance(self.file.inputs, (), forced=forced)
        page = recipe_page(self.file.recipe.title, rows, provenance)
        table = part_table_bytes(rows)
        return self._writer(self.folder / INDEX_PDF).write(
            {self.folder / TABLE: table, self.folder / INDEX: page}
        )

    def _writer(self, pdf: Path) -> Job:
        """The job, which writes its page as PDF too where the recipe wants that."""
        return replace(self.job, pdf=pdf if self.file.has_pdf else None)


def inspect_recipe(job: Job, recipe_path: Path, places: Sequence[Path]) -> Summary:
    """Inspect parts by a recipe.

    ``job``: its output is the folder of the results, made if need be. A part that is in it, done
    with the same recipe, model, scanner and cloud, is not done again. ``places``: clouds, and
    folders of clouds, in the order of the trend.
    """
    if job.output is None:
        raise OptionError("no folder is named", where="-o", remedy="name a folder for the results")
    paths = clouds_of(places)
    _check_folder(job.output, is_overwriting=job.is_overwriting)
    file = read_recipe(recipe_path)
    hashes = [fingerprint(path).sha256 for path in file.inputs]
    if file.has_pdf:
        require_pdf()
    own = replace(job, is_overwriting=True, title_block=file.title_block)
    # a scanner that was calibrated anew changes what the pages say of the cloud's calibration
    scanner = [] if file.scanner_path is None else [fingerprint(file.scanner_path).sha256]
    recipe_hash = " ".join((hashes[0], *hashes[2:], *scanner))
    run = _Run(own, job.output, file, (recipe_hash, hashes[1] if len(hashes) > 1 else ""))
    rows: list[PartRow] = []
    make_folder(job.output)
    write_files({job.output / TABLE: part_table_bytes(rows)}, is_overwriting=True)
    try:
        for k, (name, path) in enumerate(paths.items()):
            job.progress(ProgressEvent("inspect", k, len(paths), name))
            rows.append(run.row(name, path))
        job.progress(ProgressEvent("inspect", len(paths), len(paths)))
    finally:
        # also when a person interrupts: what is done is in the table
        written = run.write_all(rows)
    forced = tuple(dict.fromkeys(text for row in rows for text in row.forced))
    simulated = any(row.is_simulated for row in rows)
    return Summary(
        title=f"{len(rows)} parts inspected" + (" (simulated data)." if simulated else "."),
        quantities=recipe_quantities(file.recipe.title, rows),
        tables=(parts_table(rows),),
        warnings=sentences(f"{row.name}: {note}" for row in rows for note in row.notes),
        written=written,
        next_step=f"open {job.output / INDEX}",
        forced=forced,
        extra={"kind": "recipe inspection", "simulated": simulated},
    )


def clouds_of(places: Sequence[Path]) -> dict[str, Path]:
    """Clouds by the names of their parts; those of a folder in the order of their numbers."""
    found: dict[str, Path] = {}
    seen: dict[str, Path] = {}
    for place in places:
        for path in _clouds_in(place) if is_folder(place) else (place,):
            other = seen.setdefault(path.stem.casefold(), path)
            if other is not path:
                raise OptionError(
                    f"{path_text(other)} and {path_text(path)} would be one part '{path.stem}'",
                    where="CLOUD",
                    remedy="give the files of parts different names",
                )
            found[path.stem] = path
    return found


def _clouds_in(folder: Path) -> list[Path]:
    paths = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in CLOUD_SUFFIXES
        and path.is_file()
        and path.name[0] != "."
        # what was measured beside a cloud
        and not path.name.endswith((".points.csv", ".markers.csv"))
    ]
    if not paths:
        raise OptionError(
            "no cloud lies in this folder",
            where=path_text(folder),
            remedy=f"give a folder with files {', '.join(CLOUD_SUFFIXES)}",
        )
    return sorted(paths, key=lambda path: natural_key(path.name))


def _check_folder(folder: Path, *, is_overwriting: bool) -> None:
    """Refuse a folder that holds something else than the results of a recipe."""
    where = path_text(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError("this is a file, not a folder", where=where, remedy="name a folder")
    if not folder.parent.is_dir():
        raise OutputError(
            "there is no folder above this one", where=where, remedy="create it first"
        )
    is_own = is_part_table(folder / TABLE) or not folder.exists() or not any(folder.iterdir())
    if not is_own and not is_overwriting:
        raise OutputError(
            "this folder holds other files",
            where=where,
            remedy="name a new folder or one of earlier results, or give --force",
        )
