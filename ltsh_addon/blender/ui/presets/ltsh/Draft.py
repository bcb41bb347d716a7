import bpy

settings = bpy.context.scene.ltsh

settings.property_unset("techniques")
settings.resolution_percentage = 50
settings.anti_aliasing = 1
settings.cycles_samples = 64
settings.shadows = True
settings.shadow_rays = 64
settings.bake_size = "512"
settings.bake_error = False
