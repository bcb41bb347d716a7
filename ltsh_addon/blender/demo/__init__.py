"""The example scene."""
