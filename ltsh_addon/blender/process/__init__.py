"""The second Blender: `worker` does the jobs that the other files declare and ask for."""
