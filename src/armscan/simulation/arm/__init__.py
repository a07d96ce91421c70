# SPDX-License-Identifier: Apache-2.0
"""The measuring arm of the simulator: joints, postures, the hand that moves it."""
