"""Shading on the graphics card through Blender's `gpu` module: the same tables, the same integrals as `shading`.

    mirror     meshes, materials and lights of a scene, kept up to date; meshes are batches of `meshes`
    textures   the inputs of shaders: samples, lights, tables and looks as textures and buffers
    surfaces   the first pass: surfaces into a G-buffer
    lighting   the second pass: light of all samples
    shaders    the text of the shaders that run per pixel, from `glsl/`
    renderer   both passes for one view, with split view and false colors

Shaders are given as create infos, with explicit types and no storage buffers, for OpenGL, Vulkan and Metal alike.
"""
