# SPDX-License-Identifier: Apache-2.0
"""A scan while it is taken: the rig, its streams matched, and the session that people drive."""
