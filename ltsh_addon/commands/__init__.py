"""The command line's commands: their arguments, and what is printed."""
