# SPDX-License-Identifier: Apache-2.0
"""The commands' work: files read, pipeline called, document and page written together."""
