# SPDX-License-Identifier: Apache-2.0
"""Measured points against what a part should be: planes, balls, steps.

Too few points are an `InputError`; a feature that is not there is a `FitFailure`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
