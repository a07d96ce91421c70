# SPDX-License-Identifier: Apache-2.0
"""The operator's console: a session folder filled step by step, and its page in a browser."""
