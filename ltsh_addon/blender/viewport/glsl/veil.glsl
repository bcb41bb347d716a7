/* The lit surfaces over the background, dimmed by glass where there is any; `beside` 0: only where there is. */
void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  vec4 lit = texelFetch(behind, texel, 0);
  vec2 place = 2.0 * gl_FragCoord.xy / vec2(textureSize(behind, 0)) - 1.0;
  vec3 ray = place.x * ray_x.xyz + place.y * ray_y.xyz + ray_center.xyz;
  vec3 world = ltsh_sky_at(ray, ivec2(0), textureSize(sky, 0).x - 2);
  vec3 seen = is_seen * texelFetch(left, texel, 0).rgb * (lit.rgb + (1.0 - lit.a) * world);
  color = texelFetch(glass, texel, 0).w > 0.0 ? vec4(seen, 1.0) : beside * lit;
}
