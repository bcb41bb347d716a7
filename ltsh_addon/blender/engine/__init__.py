"""The render engine LTSH."""
