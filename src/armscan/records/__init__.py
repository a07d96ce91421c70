# SPDX-License-Identifier: Apache-2.0
"""What the instrument delivers: exposures, profiles, clouds."""
