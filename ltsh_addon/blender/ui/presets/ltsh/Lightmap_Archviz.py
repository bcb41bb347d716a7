import bpy

settings = bpy.context.scene.ltsh

settings.anti_aliasing = 4
settings.shadows = True
settings.shadow_rays = 256
settings.bake_size = "2048"
settings.bake_atlas = False
settings.bake_margin = 16
settings.bake_view = "camera"
settings.bake_passes = {"combined"}
settings.bake_error = False
settings.bake_bounces = True
settings.bake_rest_samples = 256
settings.bake_per_light = True
settings.bake_changed = True
