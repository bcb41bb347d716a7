/* The light of the view itself, but where the surface is Cycles' alone, and the rest, found by the surface's place. */
void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  vec4 lit = weight * texelFetch(picture, texel, 0);
  vec2 place = gl_FragCoord.xy / vec2(textureSize(picture, 0));
  float is_known = 1.0;
  if (has_moved != 0) {
    vec4 position = texelFetch(glass_positions, texel, 0);
    position = position.w > 0.0 ? position : texelFetch(positions, texel, 0);
    vec4 clip = projection * vec4(position.xyz, 1.0);
    is_known = position.w > 0.0 && clip.w > 0.0 ? 1.0 : 0.0;
    place = 0.5 + 0.5 * clip.xy / max(clip.w, 1e-20);
  }
  vec4 added = is_known * rest_between(place * vec2(textureSize(rest, 0)));
  float share = is_known * clamp(weight * texelFetch(of_cycles, texel, 0).x, 0.0, 1.0);
  share = max(share, added.a);
  color = vec4((1.0 - share) * lit.rgb + scale.rgb * added.rgb, 1.0 - (1.0 - share) * (1.0 - lit.a));
}
