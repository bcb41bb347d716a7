/* What texels count where no better one is of the surface: those that are not next to the place, and those that have
light of other surfaces too. */
const float FAR_WEIGHT = 1e-3, MIXED_WEIGHT = 1e-6;

/* The rest at a place of its texture, from texels of surfaces in this depth; alpha is 0 where there are none. */
vec4 rest_of_surface(vec2 place, float depth)
{
  ivec2 size = textureSize(rest, 0);
  vec2 at = place * vec2(size) - 0.5;
  ivec2 low = ivec2(floor(at)) - 1;
  vec4 sum = vec4(0.0);
  for (int number = 0; number < 16; number++) {
    ivec2 texel = low + ivec2(number % 4, number / 4);
    vec4 there = texelFetch(rest, clamp(texel, ivec2(0), size - 1), 0);
    vec2 away = abs(vec2(texel) - at);
    vec2 inner = max(1.0 - away, 0.0), outer = max(2.0 - away, 0.0);
    float weight = inner.x * inner.y + FAR_WEIGHT * outer.x * outer.y;
    weight *= there.w < 0.0 ? MIXED_WEIGHT : 1.0;
    sum += abs(abs(there.w) - depth) < LTSH_NEAR * depth ? weight * vec4(there.rgb, 1.0) : vec4(0.0);
  }
  return vec4(sum.rgb / max(sum.a, 1e-20), sum.a);
}

/* The light of the view itself, but for samples of surfaces that are Cycles' alone, and the rest, found by the surface's
place; a share of it gives way to Cycles' whole picture of the same view. */
void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  float weight = scale.w, is_everything = ambient.w, is_known = 1.0;
  vec4 lit = weight * texelFetch(picture, texel, 0);
  vec2 place = gl_FragCoord.xy / vec2(textureSize(picture, 0));
  vec4 position = texelFetch(front_positions, texel, 0);
  position = position.w > 0.0 ? position : texelFetch(positions, texel, 0);
  vec4 clip = projection * vec4(position.xyz, 1.0);
  if (has_moved != 0) {
    place = 0.5 + 0.5 * clip.xy / max(clip.w, 1e-20);
    bool is_inside = clip.w > 0.0 && place == clamp(place, vec2(0.0), vec2(1.0));
    is_known = position.w > 0.0 && is_inside ? 1.0 : 0.0;
  }
  vec3 light = rest_between(place * vec2(textureSize(rest, 0))).rgb;
  /* Pictures with fewer pixels would show a surface's light beside its edges. */
  bool is_coarse = has_moved != 0 || textureSize(rest, 0).x < textureSize(picture, 0).x;
  if (is_coarse && is_known > 0.0 && is_parallel == 0) {
    vec4 found = rest_of_surface(place, position.w > 0.0 ? clip.w : LTSH_FARTHEST);
    light = found.a > 0.0 ? found.rgb : light;
    is_known = found.a > 0.0 || has_moved == 0 ? 1.0 : 0.0;
  }
  vec3 colors = texelFetch(diffuse_colors, texel, 0).rgb + texelFetch(specular_colors, texel, 0).rgb;
  vec3 guess = texelFetch(positions, texel, 0).w > 0.0 ? ambient.rgb * colors : vec3(0.0);
  vec3 added = scale.rgb * mix(guess, light, is_known);
  vec4 given = is_everything > 0.0 ? vec4(lit.rgb, 1.0 - lit.a) : weight * texelFetch(of_cycles, texel, 0);
  color = lit + vec4(added, 0.0) - is_known * vec4(given.rgb, -given.a);
  if (whole_share > 0.0) {
    color = mix(color, vec4(texelFetch(whole, texel, 0).rgb, 1.0), whole_share);
  }
}
