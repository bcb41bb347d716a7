"""Techniques beside Cycles: the whole way from a .blend to images, errors and a report."""
