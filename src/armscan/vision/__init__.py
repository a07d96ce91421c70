# SPDX-License-Identifier: Apache-2.0
"""From pixels to stripe centres and target points."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
