/* The texture `@name@` between its texels; `at` is in texels, whose centers are at halves. */
vec4 @name@_between(vec2 at)
{
  vec2 size = vec2(textureSize(@name@, 0));
  at = clamp(at, vec2(0.5), size - 0.5) - 0.5;
  ivec2 low = ivec2(floor(at)), high = min(low + 1, ivec2(size) - 1);
  vec2 share = at - vec2(low);
  vec4 below = mix(texelFetch(@name@, low, 0), texelFetch(@name@, ivec2(high.x, low.y), 0), share.x);
  vec4 above = mix(texelFetch(@name@, ivec2(low.x, high.y), 0), texelFetch(@name@, high, 0), share.x);
  return mix(below, above, share.y);
}
