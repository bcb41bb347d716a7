import bpy

settings = bpy.context.scene.ltsh

settings.property_unset("techniques")
settings.resolution_percentage = 100
settings.anti_aliasing = 4
settings.cycles_samples = 256
settings.shadows = True
settings.shadow_rays = 256
settings.bake_size = "1024"
settings.bake_error = False
