# SPDX-License-Identifier: Apache-2.0
"""Models of parts: STL, PLY, OBJ and STEP files, and tables of their tolerances."""
