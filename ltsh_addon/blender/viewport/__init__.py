"""Shading on the graphics card through Blender's `gpu` module: the same tables, the same integrals as `shading`.

    gbuffer_textures   what a picture's surface points need, as textures
    light_texture      area lights as one texture
    table_texture      lookup tables as an array texture
    lighting_source    the GLSL text of the lighting pass
    polygon_source     the part of it that integrates over lights
    lighting           the pass itself: compiles, uploads, draws
    composite          split view and false-color difference of two pictures

Shaders are given as create infos, with explicit types and no storage buffers, for OpenGL, Vulkan and Metal alike.
"""
