# SPDX-License-Identifier: Apache-2.0
"""Files: images, calibrations, clouds.

What reads a file raises `FileFormatError` where it is missing, empty, cut, damaged, in another
unit, or not of the kind that is asked for; what writes one raises `OutputError` where it exists or
the disk refuses, and leaves nothing half written. Docstrings name what is raised beyond that.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
