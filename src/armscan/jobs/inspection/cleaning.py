# SPDX-License-Identifier: Apache-2.0
"""From a cloud to a cleaned one, and the page that shows what was taken out."""

from __future__ import annotations

from pathlib import Path

from armscan.errors import OptionError
from armscan.inspection.cleaning import CleaningOptions, clean_cloud
from armscan.jobs.job import Job
from armscan.report.inspection.cleaning import cleaning_page, cleaning_quantities, cleaning_table
from armscan.report.quantity import Summary, sentences
from armscan.storage.clouds import CLOUD_SUFFIXES, cloud_bytes, cloud_losses, read_cloud_file


def clean(job: Job, path: Path, options: CleaningOptions) -> Summary:
    """Clean a cloud.

    Parameters
    ----------
    job
        Where to write the cleaned cloud; ``NAME.html`` is written beside it.
    path
        A cloud in any format that is read.
    options
        Which filters take points out.

    Raises
    ------
    ArmscanError
        If the file is unreadable, an option is wrong, or no point is left; nothing is written then.
    """
    if job.output is None:
        raise OptionError("no output is named", where="-o", remedy="name the cloud to write")
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",))
    source = read_cloud_file(path)
    cloud = source.cloud
    found = clean_cloud(cloud, options)
    losses = cloud_losses(found.cloud, job.output, source.dropped)
    lost = (f"the new file does not hold: {', '.join(losses)}",) if losses else ()
    warnings = (*found.warnings, *lost)
    provenance = job.provenance((path,), (options,), warnings=warnings, forced=cloud.forced)
    page = cleaning_page(found, cloud.points_mm, provenance, is_simulated=cloud.is_simulated)
    written = job.write({places[0]: cloud_bytes(found.cloud, job.output), places[1]: page})
    return Summary(
        title="Cloud cleaned" + (" (simulated data)." if cloud.is_simulated else "."),
        quantities=cleaning_quantities(found),
        tables=(cleaning_table(found),),
        warnings=sentences(warnings),
        written=written,
        next_step=f"open {places[1]}",
        forced=cloud.forced,
        extra={"kind": "cleaning", "simulated": cloud.is_simulated, "frame": cloud.frame},
    )
