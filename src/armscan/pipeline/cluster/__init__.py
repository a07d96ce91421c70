# SPDX-License-Identifier: Apache-2.0
"""Work of a scan on several processes or machines."""
