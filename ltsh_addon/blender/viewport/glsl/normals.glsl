/* Normal of a tangent space normal map. As in Cycles it bends the object's normal before the transformation, and
 * interpolated tangents are not made unit vectors. */
vec3 mapped_normal(vec3 normal, bool backfacing)
{
  if (dot(v_tangent.xyz, v_tangent.xyz) == 0.0) {
    return normal;
  }
  vec3 unbent = UNIT_NORMALS ? normalize(v_object_normal) : v_object_normal;
  vec3 bitangent = v_tangent.w * cross(unbent, v_tangent.xyz);
  vec3 color = 2.0 * slot_value(normal_image, NORMAL_SLOT, v_uv) - 1.0;
  float strength = look.data[0].w;
  color = vec3(color.xy * strength, mix(1.0, color.z, clamp(strength, 0.0, 1.0)));
  vec3 bent = color.x * v_tangent.xyz + color.y * bitangent + color.z * unbent;
  bent = normalize(transpose(inverse(mat3(model))) * bent);
  return backfacing ? -bent : bent;
}

/* As `cycles.horizons.valid_specular_normal`. */
vec3 valid_specular_normal(vec3 normal, vec3 true_normal, vec3 towards_eye)
{
  float elevation = dot(towards_eye, true_normal);
  float threshold = min(ELEVATION_SHARE * elevation, MINIMUM_REFLECTION_ELEVATION);
  vec3 mirrored = 2.0 * dot(normal, towards_eye) * normal - towards_eye;
  if (dot(mirrored, true_normal) >= threshold) {
    return normal;
  }
  vec3 flat_part = normal - dot(normal, true_normal) * true_normal;
  float size = length(flat_part);
  if (size == 0.0) {
    return normal;
  }
  vec3 tangent = flat_part / size;
  float x = dot(towards_eye, tangent);
  float span = length(vec2(x, elevation));
  float ratio = span > 0.0 ? threshold / span : 1.0;
  float angle = 0.5 * (atan(x, elevation) + acos(clamp(ratio, -1.0, 1.0)));
  return sin(angle) * tangent + cos(angle) * true_normal;
}

/* As `cycles.horizons.bump_alpha2`. */
float bump_alpha2(vec3 normal, vec3 smooth_normal)
{
  float cosine = dot(normal, smooth_normal);
  float cosine2 = cosine * cosine;
  return cosine2 > 0.0 ? clamp((1.0 - cosine2) / cosine2 / 8.0, 0.0, 1.0) : 1.0;
}

#ifdef DRAWS_TANGENTS
/* The tangent of the anisotropic lobe as in Cycles, turned around an axis. */
vec3 turned_tangent(vec3 smooth_normal, vec3 axis)
{
  vec4 brush = look.data[LAYERS + 4];
  int direction = int(brush.z + 0.5);
  vec3 a = v_around;
  vec3 tangent = v_tangent.xyz;
  tangent = direction == 1 ? vec3(0.0, -a.z, a.y) : tangent;
  tangent = direction == 2 ? vec3(-a.z, 0.0, a.x) : tangent;
  tangent = direction == 3 ? vec3(-a.y, a.x, 0.0) : tangent;
  tangent = cross(transpose(inverse(mat3(model))) * tangent, smooth_normal);
  float size = length(tangent);
  tangent = size > 0.0 ? cross(smooth_normal, tangent / size) : vec3(0.0);
  vec3 beside = dot(axis, tangent) * axis;
  return beside + cos(brush.y) * (tangent - beside) + sin(brush.y) * cross(axis, tangent);
}
#endif
