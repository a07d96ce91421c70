# SPDX-License-Identifier: Apache-2.0
"""Jobs that inspect a cloud: against a standard shape, or against the CAD model of a part."""
