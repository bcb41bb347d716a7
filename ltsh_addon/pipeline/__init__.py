"""A .blend in, files out: pictures, bakes, comparisons, tasks."""
