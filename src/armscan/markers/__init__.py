# SPDX-License-Identifier: Apache-2.0
"""Ring markers in space: matched between two cameras, decoded, and used to join scans."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
