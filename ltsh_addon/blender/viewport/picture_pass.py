"""From shaded pictures to what the view shows: exposure, background, split view, false color of a difference."""

from __future__ import annotations

import gpu
from gpu_extras.batch import batch_for_shader

MODES = ("single", "split", "difference")
_TRIANGLE = ((-1.0, -1.0), (3.0, -1.0), (-1.0, 3.0))
_VERTEX = """
void main()
{
  gl_Position = vec4(corner, 0.0, 1.0);
}
"""
# Red is brighter, blue darker, white equal, as in `imaging.false_color`.
_FRAGMENT = """
vec4 over_background(vec4 lit)
{
  float alpha = mix(lit.a, 1.0, background.a);
  return vec4(lit.rgb * scales.x + background.rgb * (1.0 - lit.a), alpha);
}

void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy) - place.xy;
  vec4 first = texelFetch(first_picture, texel, 0);
  vec4 second = texelFetch(second_picture, texel, 0);
  second.a = min(first.a, second.a);
  color = over_background(first);
  if (place.z == 1) {
    float beyond = float(texel.x) + 0.5 - scales.z;
    color = beyond > 0.0 ? over_background(second) : color;
    color = abs(beyond) <= scales.w ? vec4(vec3(0.8), 1.0) : color;
  }
  else if (place.z == 2) {
    float difference = dot(first.rgb - second.rgb, vec3(1.0 / 3.0)) * scales.x / scales.y;
    float strength = clamp(abs(difference), 0.0, 1.0);
    vec3 side = difference > 0.0 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 0.0, 1.0);
    color = vec4((second.a > 0.0 ? mix(vec3(1.0), side, strength) : vec3(0.2)) * white, 1.0);
  }
}
"""


class PicturePass:
    """Draws one or two pictures into what is bound; needs an active GPU context."""

    def __init__(self):
        info = gpu.types.GPUShaderCreateInfo()
        info.vertex_in(0, "VEC2", "corner")
        info.fragment_out(0, "VEC4", "color")
        info.push_constant("IVEC4", "place")
        info.push_constant("VEC4", "scales")
        info.push_constant("VEC4", "background")
        info.push_constant("FLOAT", "white")
        info.sampler(0, "FLOAT_2D", "first_picture")
        info.sampler(1, "FLOAT_2D", "second_picture")
        info.vertex_source(_VERTEX)
        info.fragment_source(_FRAGMENT)
        self._shader = gpu.shader.create_from_info(info)
        self._batch = batch_for_shader(self._shader, "TRIS", {"corner": _TRIANGLE})

    def draw(
        self,
        first: gpu.types.GPUTexture,
        second: gpu.types.GPUTexture | None,
        rect: tuple[int, int, int, int],
        *,
        mode: str = "single",
        exposure: float = 1.0,
        background=(0.0, 0.0, 0.0),
        transparent: bool = False,
        split: float = 0.5,
        difference_scale: float = 1.0,
        line_width: float = 1.0,
        white: float = 1.0,
    ) -> None:
        """Fill `rect` (x, y, width, height) of what is bound, scene-linear, from pictures RGBA with alpha 1 where they
        show a surface. `mode` is one of MODES; `split` is the place of the line between 0 and 1, `white` the
        brightness of no difference."""
        x, y, width, height = rect
        gpu.state.viewport_set(x, y, width, height)
        gpu.state.blend_set("NONE")
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        shader = self._shader
        shader.bind()
        shader.uniform_sampler("first_picture", first)
        shader.uniform_sampler("second_picture", first if second is None else second)
        shader.uniform_int("place", (x, y, MODES.index(mode), 0))
        shader.uniform_float("scales", (exposure, difference_scale, split * width, 0.5 * line_width))
        behind = (0.0, 0.0, 0.0) if transparent else [exposure * float(value) for value in background]
        shader.uniform_float("background", (*behind, 0.0 if transparent else 1.0))
        shader.uniform_float("white", white)
        self._batch.draw(shader)
