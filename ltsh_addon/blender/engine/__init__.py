"""The render engine: what F12 and the rendered view show."""
