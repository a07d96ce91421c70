# SPDX-License-Identifier: Apache-2.0
"""One thread for each test process: two processes share the machine already."""

from __future__ import annotations

import os

for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(library, "1")
