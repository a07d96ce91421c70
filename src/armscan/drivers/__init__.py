# SPDX-License-Identifier: Apache-2.0
"""One file a protocol or vendor; reached by name through `armscan.devices.registry`.

What opens a device raises `DeviceError` where it is not there, taken, or of another kind.
"""
