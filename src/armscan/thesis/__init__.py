# SPDX-License-Identifier: Apache-2.0
"""The methods as the thesis prints them, to set beside the product's: one module a subject."""
