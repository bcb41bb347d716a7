import bpy

settings = bpy.context.scene.ltsh

settings.anti_aliasing = 4
settings.shadows = True
settings.shadow_rays = 256
settings.bake_size = "2048"
settings.bake_atlas = True
settings.bake_margin = 8
settings.bake_view = "above"
settings.bake_passes = {"diffuse_light"}
settings.bake_error = False
settings.bake_bounces = True
settings.bake_rest_samples = 64
settings.bake_per_light = False
settings.bake_changed = True
