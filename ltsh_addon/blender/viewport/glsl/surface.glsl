/* Draws surfaces into the G-buffer, lobe by lobe, as `cycles.lobes` computes samples. */

#if defined(IS_FURTHER) || defined(DRAWS_EMISSION) || defined(DRAWS_THROUGH)
/* True if this is the surface of the G-buffer, for everything that is drawn after the first lobe. */
bool is_seen()
{
  vec4 seen = texelFetch(positions, ivec2(gl_FragCoord.xy), 0);
  vec3 between = seen.xyz - v_position;
  float distance2 = view.eye.w < 0.5 ? 1.0 : dot(view.eye.xyz - v_position, view.eye.xyz - v_position);
  return seen.w != 0.0 && dot(between, between) <= 1e-7 * distance2;
}
#endif

@FUNCTIONS@
#if defined(DRAWS_SURFACES) || defined(DRAWS_TANGENTS)
/* Both alphas of a lobe that takes in how its `normal` turns within a point's share of a pixel: as
   `gbuffer.with_widened_lobes` does. */
vec2 widened(vec2 alphas, vec3 normal)
{
  vec3 right = dFdx(normal);
  vec3 up = dFdy(normal);
  return sqrt(alphas * alphas + min(view.widening.x * (dot(right, right) + dot(up, up)), view.widening.y));
}
#endif

#ifdef DRAWS_EMISSION
void main()
{
  if (!is_seen()) {
    discard;
  }
  float glow = look.data[LAYERS + 2].w;
  vec3 shown = glow > 0.0 ? glow * max(slot_value(color_image, COLOR_SLOT, v_uv), vec3(0.0)) : vec3(0.0);
  out_emission = vec4(look.data[1].xyz + shown, 0.0);
}
#else
void main()
{
  bool backfacing = gl_FrontFacing == (placement.y < 0.0);
  vec3 towards_eye = view.eye.w < 0.5 ? view.eye.xyz : normalize(view.eye.xyz - v_position);
  vec3 smooth_normal = normalize(v_normal) * (backfacing ? -1.0 : 1.0);
  vec3 true_normal = normalize(cross(dFdx(v_position), dFdy(v_position)));
  true_normal *= dot(true_normal, towards_eye) < 0.0 ? -1.0 : 1.0;
  /* Derivatives are rounded: for flat meshes the normals of the mesh are exact. */
  true_normal = placement.z > 0.0 ? true_normal : smooth_normal;
  vec3 diffuse_normal = smooth_normal;
  vec3 specular_normal = smooth_normal;
  float alpha2 = 0.0;
  int flags = int(look.data[0].z + 0.5);
  if (flags % 2 == 1) {
    diffuse_normal = mapped_normal(smooth_normal, backfacing);
    specular_normal = diffuse_normal;
    alpha2 = flags >= 2 ? bump_alpha2(diffuse_normal, smooth_normal) : 0.0;
  }
  if (flags >= 2) {
    specular_normal = valid_specular_normal(diffuse_normal, true_normal, towards_eye);
  }

#if defined(DRAWS_SURFACES) || defined(DRAWS_THROUGH)
  vec3 color = max(slot_value(color_image, COLOR_SLOT, v_uv), vec3(0.0));
  vec2 alphas = brushed_alphas(clamp(slot_value(roughness_image, ROUGHNESS_SLOT, v_uv).x, 0.0, 1.0));
  float roughness = mean_roughness(alphas);
  float metallic = clamp(slot_value(metallic_image, METALLIC_SLOT, v_uv).x, 0.0, 1.0);
  float ior = max(slot_value(ior_image, IOR_SLOT, v_uv).x, 1e-5);
  float cosine = clamp(dot(specular_normal, towards_eye), 0.0, 1.0);
  vec3 weight = vec3(look.data[LAYERS].x);
  weight *= clamp(slot_value(weight_image, WEIGHT_SLOT, v_uv).x, 0.0, 1.0);
  weight *= view_factor(look.data[LAYERS + 2].xyz, abs(dot(smooth_normal, towards_eye)), backfacing);
  if (look.data[LAYERS].y > 0.0 && int(look.data[0].x + 0.5) != COAT) {
    vec3 coat_normal = specular_normal;
    if (look.data[LAYERS + 1].w < 0.5) {
      coat_normal = flags >= 2 ? valid_specular_normal(smooth_normal, true_normal, towards_eye) : smooth_normal;
    }
    weight *= left_under_coat(clamp(dot(coat_normal, towards_eye), 0.0, 1.0));
  }
  float fuzz = look.data[LAYERS + 3].x;
  weight *= fuzz > 0.0 ? clamp(1.0 - fuzz * sheen_at(cosine, look.data[LAYERS + 3].y).x, 0.0, 1.0) : 1.0;
#endif
#ifdef DRAWS_THROUGH
  out_through = vec4(weight * let_through(color, metallic, ior, cosine), 0.0);
#elif defined(DRAWS_SURFACES)
  bool leaves = backfacing && int(look.data[0].x + 0.5) == GLASS;
  Lobe lobe = lobe_of_look(color, roughness, metallic, leaves ? 1.0 / ior : ior, cosine);
  /* As in `cycles.lobes`. */
  lobe.diffuse *= dot(diffuse_normal, smooth_normal) <= 0.0 ? 0.0 : 1.0;
  out_position = vec4(v_position, 1.0 + placement.x);
  bool is_fuzz = int(look.data[0].x + 0.5) == SHEEN;
  out_normal = vec4(specular_normal, is_fuzz ? lobe.roughness : mean_roughness(widened(alphas, specular_normal)));
  out_base = vec4(weight * lobe.diffuse, lobe.ior);
  out_f0 = vec4(weight * lobe.f0, weight.r * lobe.dip.r);
  out_f90 = vec4(weight * lobe.f90, weight.g * lobe.dip.g);
  out_dielectric = vec4(weight * lobe.dielectric, weight.b * lobe.dip.b);
#elif defined(DRAWS_TANGENTS)
  vec2 alphas = brushed_alphas(clamp(slot_value(roughness_image, ROUGHNESS_SLOT, v_uv).x, 0.0, 1.0));
  alphas = widened(alphas, specular_normal);
  float ratio = alphas.x > 0.0 ? sqrt(alphas.y / alphas.x) : 1.0;
  vec3 axis = int(look.data[0].x + 0.5) == GLOSSY ? specular_normal : diffuse_normal;
  out_tangent = vec4(turned_tangent(smooth_normal, axis), 1.0 - ratio);
#elif defined(DRAWS_REBOUNDS)
  vec3 color = max(slot_value(color_image, COLOR_SLOT, v_uv), vec3(0.0));
  float cosine = clamp(dot(diffuse_normal, towards_eye), 0.0, 1.0);
  float sigma = look.data[LAYERS + 3].z;
  out_rebound = vec4(rebound_of(color, cosine, sigma), sigma);
  if (int(look.data[0].x + 0.5) == VELVET) {
    float roughness = clamp(slot_value(roughness_image, ROUGHNESS_SLOT, v_uv).x, LEAST_VELVET, 1.0);
    /* The layout of `GBufferTextures` for velvet. */
    out_rebound = vec4(vec3(sheen_at(cosine, roughness).w), -roughness);
  }
#else
  out_geometric_normal = vec4(true_normal, 0.0);
  if (int(look.data[0].x + 0.5) == TRANSLUCENT) {
    diffuse_normal = -specular_normal;
    smooth_normal = -smooth_normal;
  }
  out_diffuse_normal = vec4(diffuse_normal, alpha2);
  out_smooth_normal = vec4(smooth_normal, 0.0);
#endif
#if defined(IS_FURTHER) || defined(DRAWS_THROUGH)
  if (!is_seen()) {
    discard;
  }
#endif
}
#endif
