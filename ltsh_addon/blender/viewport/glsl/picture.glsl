/* False colors as in `imaging.color.false_color`: red is brighter, blue darker, white equal. */
vec4 over_background(vec4 lit, vec3 behind)
{
  return vec4(scales.x * (lit.rgb + (1.0 - lit.a) * behind), mix(lit.a, 1.0, opacity));
}

void main()
{
  /* A picture of a view that moves may have fewer pixels than are shown. */
  vec4 first = weights.x * first_picture_between(gl_FragCoord.xy * (vec2(textureSize(first_picture, 0)) / size));
  vec4 second = weights.y * second_picture_between(gl_FragCoord.xy * (vec2(textureSize(second_picture, 0)) / size));
  second.a = min(first.a, second.a);
  vec2 place = 2.0 * gl_FragCoord.xy / size - 1.0;
  vec3 ray = place.x * ray_x.xyz + place.y * ray_y.xyz + ray_center.xyz;
  vec3 behind = ray_center.w * ltsh_sky_at(ray, ivec2(0), textureSize(sky, 0).x - 2);
  color = over_background(first, behind);
  if (mode == LTSH_SPLIT) {
    float beyond = gl_FragCoord.x - scales.z;
    color = beyond > 0.0 ? over_background(second, behind) : color;
    color = abs(beyond) <= scales.w ? vec4(vec3(0.8), 1.0) : color;
  }
  else if (mode == LTSH_DIFFERENCE) {
    float difference = dot(first.rgb - second.rgb, vec3(1.0 / 3.0)) * scales.x / scales.y;
    float strength = clamp(abs(difference), 0.0, 1.0);
    vec3 side = difference > 0.0 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 0.0, 1.0);
    color = vec4((second.a > 0.0 ? mix(vec3(1.0), side, strength) : vec3(0.2)) * white, 1.0);
  }
}
