"""Child processes that share the work of this one."""
