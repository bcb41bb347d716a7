"""The second Blender: `client` asks, `worker` answers, `blender_process` is the process between them."""
