"""Samples of a camera's pixels, and Cycles' reference of the same pixels."""
