# SPDX-License-Identifier: Apache-2.0
"""One file a protocol or vendor; reached by name through `armscan.devices.registry`."""
