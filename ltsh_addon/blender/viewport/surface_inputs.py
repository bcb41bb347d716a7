"""GLSL of the quantities of a look, from constants and images, and of normals.

The uniform buffer `look` is an array of vec4 (see `surface_uniforms`). Images are read by texelFetch, since Blender 4.5
has no say in a texture's filter and extension.
"""

IMAGES = """
int wrapped(int texel, int size, int extension)
{
  if (extension == 0) {
    int inside = texel % size;
    return inside < 0 ? inside + size : inside;
  }
  if (extension == 3) {
    int period = 2 * size;
    int inside = texel % period;
    inside = inside < 0 ? inside + period : inside;
    return inside < size ? inside : period - 1 - inside;
  }
  return clamp(texel, 0, size - 1);
}

float encoded(float value)
{
  return value <= 0.0031308 ? 12.92 * value : 1.055 * pow(value, 1.0 / 2.4) - 0.055;
}

float decoded(float value)
{
  return value <= 0.04045 ? value / 12.92 : pow((value + 0.055) / 1.055, 2.4);
}

vec4 texel_at(sampler2D image, ivec2 texel, ivec2 size, int extension, bool encode)
{
  if (extension == 2 && (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, size)))) {
    return vec4(0.0);
  }
  ivec2 place = ivec2(wrapped(texel.x, size.x, extension), wrapped(texel.y, size.y, extension));
  vec4 value = texelFetch(image, place, 0);
  if (encode) {
    value.rgb = vec3(encoded(value.r), encoded(value.g), encoded(value.b));
  }
  return value;
}

/* The quantity of a slot: its offset, plus its matrix times the image where there is one. */
vec3 slot_value(sampler2D image, int slot, vec2 uv)
{
  int base = FIRST_SLOT + SLOT_SIZE * slot;
  vec4 offset = look.data[base + 3];
  if (offset.w < 0.5) {
    return offset.xyz;
  }
  vec4 row_u = look.data[base + 4];
  vec4 row_v = look.data[base + 5];
  vec3 place = vec3(uv, 1.0);
  int code = int(row_v.w + 0.5);
  int extension = code % 4;
  bool encode = code >= 4;
  ivec2 size = textureSize(image, 0);
  vec2 texel = vec2(dot(row_u.xyz, place), dot(row_v.xyz, place)) * vec2(size);
  vec4 value;
  if (row_u.w > 0.5) {
    value = texel_at(image, ivec2(floor(texel)), size, extension, false);
    encode = false;
  }
  else {
    texel -= 0.5;
    ivec2 corner = ivec2(floor(texel));
    vec2 share = texel - floor(texel);
    vec4 low = mix(texel_at(image, corner, size, extension, encode),
                   texel_at(image, corner + ivec2(1, 0), size, extension, encode),
                   share.x);
    vec4 high = mix(texel_at(image, corner + ivec2(0, 1), size, extension, encode),
                    texel_at(image, corner + ivec2(1, 1), size, extension, encode),
                    share.x);
    value = mix(low, high, share.y);
  }
  if (encode) {
    value.rgb = vec3(decoded(value.r), decoded(value.g), decoded(value.b));
  }
  return offset.xyz +
         vec3(dot(look.data[base], value), dot(look.data[base + 1], value), dot(look.data[base + 2], value));
}
"""

NORMALS = """
/* Normal of a tangent space normal map. As in Cycles it bends the normal of the object before that is transformed, and
 * interpolated tangents are not made unit vectors. */
vec3 mapped_normal(vec3 normal, bool backfacing)
{
  if (dot(v_tangent.xyz, v_tangent.xyz) == 0.0) {
    return normal;
  }
  vec3 unbent = UNIT_NORMALS ? normalize(v_object_normal) : v_object_normal;
  vec3 bitangent = v_tangent.w * cross(unbent, v_tangent.xyz);
  vec3 color = 2.0 * slot_value(normal_image, 4, v_uv) - 1.0;
  float strength = look.data[0].w;
  color = vec3(color.xy * strength, mix(1.0, color.z, clamp(strength, 0.0, 1.0)));
  vec3 bent = color.x * v_tangent.xyz + color.y * bitangent + color.z * unbent;
  bent = normalize(transpose(inverse(mat3(model))) * bent);
  return backfacing ? -bent : bent;
}

/* As `shading_normals.valid_specular_normal`. */
vec3 valid_specular_normal(vec3 normal, vec3 true_normal, vec3 towards_eye)
{
  float elevation = dot(towards_eye, true_normal);
  float threshold = min(0.9 * elevation, 0.01);
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

float bump_alpha2(vec3 normal, vec3 smooth_normal)
{
  float cosine = dot(normal, smooth_normal);
  float cosine2 = cosine * cosine;
  return cosine2 > 0.0 ? clamp((1.0 - cosine2) / cosine2 / 8.0, 0.0, 1.0) : 1.0;
}
"""
