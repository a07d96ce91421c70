# SPDX-License-Identifier: Apache-2.0
"""The command line.

The matrices here are small: several threads of the linear algebra library cost more than they
bring, many times more on a busy machine. The libraries read these variables when they are loaded,
so that they are set before anything is imported; what a person has set stays.
"""

from __future__ import annotations

import os

if "OMP_NUM_THREADS" not in os.environ:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MKL_NUM_THREADS", "1")
    os.environ.setdefault("VECLIB_MAXIMUM_THREADS", "1")

from armscan.cli.run import main

__all__ = ["main"]
