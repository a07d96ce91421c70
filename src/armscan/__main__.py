# SPDX-License-Identifier: Apache-2.0
"""``python -m armscan``: the command line where its script is not on the path."""

from armscan.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
