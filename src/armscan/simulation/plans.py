# SPDX-License-Identifier: Apache-2.0
"""Tables that lie beside the simulator as TOML: the printed heads, and what the hand does."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any

PRINTED: dict[str, Any] = tomllib.loads((files(__package__) / "heads.toml").read_text("utf-8"))
PLANS: dict[str, Any] = tomllib.loads((files(__package__) / "scenes.toml").read_text("utf-8"))
