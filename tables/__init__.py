"""The shipped lookup tables, and the code that fits and measures them."""
