# SPDX-License-Identifier: Apache-2.0
"""Protocols and the registry of drivers."""
