"""Jobs of many tasks: which there are, doing them or a share of them, records of what is done, job files."""
