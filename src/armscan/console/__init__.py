# SPDX-License-Identifier: Apache-2.0
"""The operator's console: a session folder filled step by step, and its page in a browser.

What stands in the way, a file, a device or the disk, is an `ArmscanError` with its sentence.
"""
