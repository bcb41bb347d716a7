/* Distances from the eye that differ by this share are those of different surfaces. */
const float NEAR = 0.05;

/* The light of the view itself, but where the surface is Cycles' alone, and the rest, found by the surface's place. */
void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  float weight = scale.w, is_everything = ambient.w, is_known = 1.0;
  vec4 lit = weight * texelFetch(picture, texel, 0);
  vec2 place = gl_FragCoord.xy / vec2(textureSize(picture, 0));
  if (has_moved != 0) {
    vec4 position = texelFetch(front_positions, texel, 0);
    position = position.w > 0.0 ? position : texelFetch(positions, texel, 0);
    vec4 clip = projection * vec4(position.xyz, 1.0);
    place = 0.5 + 0.5 * clip.xy / max(clip.w, 1e-20);
    ivec2 size = textureSize(rest, 0);
    float distance = texelFetch(rest, clamp(ivec2(place * vec2(size)), ivec2(0), size - 1), 0).w;
    bool is_near = eye.w < 0.5 || abs(length(position.xyz - eye.xyz) - distance) < NEAR * distance;
    bool is_inside = clip.w > 0.0 && place == clamp(place, vec2(0.0), vec2(1.0));
    is_known = position.w > 0.0 && is_inside && is_near ? 1.0 : 0.0;
  }
  vec3 colors = texelFetch(diffuse_colors, texel, 0).rgb + texelFetch(specular_colors, texel, 0).rgb;
  vec3 guess = texelFetch(positions, texel, 0).w > 0.0 ? ambient.rgb * colors : vec3(0.0);
  vec3 added = scale.rgb * mix(guess, rest_between(place * vec2(textureSize(rest, 0))).rgb, is_known);
  float share = is_known * max(clamp(weight * texelFetch(of_cycles, texel, 0).x, 0.0, 1.0), is_everything);
  color = vec4((1.0 - share) * lit.rgb + added, 1.0 - (1.0 - share) * (1.0 - lit.a));
}
