# SPDX-License-Identifier: Apache-2.0
"""Ring markers in space: matched between two cameras, decoded, and used to join scans."""
