"""Shading on the graphics card through Blender's `gpu` module: the same tables, the same integrals as `shading`.

    mirror           what is drawn: materials, instances and lights of a scene, kept up to date; its meshes are in
                     `meshes`, its world in `light_texels`, what Cycles tells of worlds and lights in `live_cycles`
    drawing          how all passes draw: the camera, the G-buffer, shaders that run once per pixel, the card's state
    surfaces         the first pass: surfaces into a G-buffer, of materials whose textures are in `meshes`
    lighting         the second pass: the light of all lobes, from lights, sky and tables in `light_texels`; its shaders
                     are made by `shaders` from `glsl/`
    shadow_rays      the visibility of lights, traced at once; `shadows` traces it while an artist works
    pictures         the last pass: one picture or two, as a split view or in false colors; and what does not change
    renderer         all passes for one view, layer by layer: surfaces or glass
    still            the same without a window

Shaders are given as create infos, with explicit types and no storage buffers, for OpenGL, Vulkan and Metal alike.
"""
