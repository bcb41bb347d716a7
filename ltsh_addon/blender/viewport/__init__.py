"""Shading on the graphics card through Blender's `gpu` module: the same tables, the same integrals as `shading`.

    mirror           what is drawn: materials and instances of a scene, kept up to date; its meshes are in `meshes`,
                     its lights in `lights`, its world in `sky`, what Cycles tells of both in `live_cycles`
    drawing          how all passes draw: shaders that run once per pixel, textures, the card's state
    surfaces         the first pass: surfaces into a G-buffer (`gbuffer`), of materials in `textures`
    layers           surfaces or glass, with the horizons that end their lobes
    lighting         the second pass: the light of all lobes, from lights and tables in `light_texels`; its shaders
                     are made by `shaders` from `glsl/`
    shadow_rays      the visibility of lights, traced at once; `shadows` traces it while an artist works
    pictures         the last pass: one picture or two, as a split view or in false colors
    renderer         all passes for one view, through its `camera`; `static_lighting` keeps what does not change
    still            the same without a window

Shaders are given as create infos, with explicit types and no storage buffers, for OpenGL, Vulkan and Metal alike.
"""
