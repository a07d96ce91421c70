# SPDX-License-Identifier: Apache-2.0
"""Stripe centres in images."""
