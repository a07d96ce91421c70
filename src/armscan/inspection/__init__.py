# SPDX-License-Identifier: Apache-2.0
"""Measured points against what a part should be: planes, balls, steps."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
