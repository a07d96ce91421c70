# SPDX-License-Identifier: Apache-2.0
"""What a registration by markers holds, in a few lines."""

from __future__ import annotations

from typing import Any

from armscan.storage.registration_files import RegistrationDocument


def describe_registration(document: RegistrationDocument) -> dict[str, Any]:
    """Scans, markers and evidence of ``registration.json``."""
    return {
        "what": f"registration by markers ({document.kind}), {len(document.transforms)} scans in "
        f"the {document.common_frame} frame of {document.common_frame_of}",
        "scans": [one.name for one in document.transforms],
        "markers": sum(one.n_markers for one in document.transforms),
        "rms_mm": [one.rms_mm for one in document.transforms],
        "moved_markers": [one.id for one in document.moved],
        "not_joined": [one.name for one in document.not_joined],
        "simulated": document.simulated,
        "created_utc": document.provenance.created_utc,
        "command": " ".join(document.provenance.command),
    }
