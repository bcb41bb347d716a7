"""Shading on the graphics card through Blender's `gpu` module: the same tables, the same integrals as `shading`.

    gbuffer_textures   what a picture's surface points need, as textures
    light_texture      area lights as one texture
    uploaded_lights    the same on the card, for all passes
    table_texture      lookup tables as an array texture
    lighting_source    the GLSL text of the lighting pass
    polygon_source     the part of it that integrates over lights
    spread_source      the same over lights with a spread, by disk_parts_source
    lighting           the pass itself: compiles, uploads, draws
    surface_source     the GLSL text that draws surfaces; surface_inputs and surface_lobes are parts of it
    surface_pass       the pass that draws them into a G-buffer
    horizon_pass       chooses where specular lobes end; its GLSL is in horizon_source
    scene_mirror       meshes, materials and lights, kept in step with the scene
    picture_pass       split view and false-color difference of two pictures
    view_renderer      all of it for one view

Shaders are given as create infos, with explicit types and no storage buffers, for OpenGL, Vulkan and Metal alike.
"""
