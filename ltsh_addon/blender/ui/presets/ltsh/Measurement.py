import bpy

settings = bpy.context.scene.ltsh

settings.techniques = {"ltc", "ltsh2", "ltsh4", "ltsh4c", "reference"}
settings.resolution_percentage = 100
settings.anti_aliasing = 16
settings.cycles_samples = 2048
settings.shadows = True
settings.shadow_rays = 1024
settings.bake_size = "2048"
settings.bake_error = True
