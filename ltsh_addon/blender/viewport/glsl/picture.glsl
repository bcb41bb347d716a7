/* False colors as in `imaging.color.false_color`: red is brighter, blue darker, white equal. */
vec4 over_background(vec4 lit)
{
  float alpha = mix(lit.a, 1.0, background.a);
  return vec4(lit.rgb * scales.x + background.rgb * (1.0 - lit.a), alpha);
}

void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  vec4 first = weights.x * texelFetch(first_picture, texel, 0);
  vec4 second = weights.y * texelFetch(second_picture, texel, 0);
  second.a = min(first.a, second.a);
  color = over_background(first);
  if (mode == LTSH_SPLIT) {
    float beyond = float(texel.x) + 0.5 - scales.z;
    color = beyond > 0.0 ? over_background(second) : color;
    color = abs(beyond) <= scales.w ? vec4(vec3(0.8), 1.0) : color;
  }
  else if (mode == LTSH_DIFFERENCE) {
    float difference = dot(first.rgb - second.rgb, vec3(1.0 / 3.0)) * scales.x / scales.y;
    float strength = clamp(abs(difference), 0.0, 1.0);
    vec3 side = difference > 0.0 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 0.0, 1.0);
    color = vec4((second.a > 0.0 ? mix(vec3(1.0), side, strength) : vec3(0.2)) * white, 1.0);
  }
}
