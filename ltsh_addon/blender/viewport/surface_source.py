"""GLSL of the passes that draw surfaces into the G-buffer: what `lobe_samples` does for pixels, for one lobe.

The smooth normal stands in for the geometric one: of both horizons Cycles mostly keeps to its own (`specular_horizon`).

The uniform buffer `Look` is an array of vec4 (see `surface_uniforms`). Images are read by texelFetch, since Blender 4.5
has no say in a texture's filter and extension.
"""

VERTEX = """
void main()
{
  vec4 world = model * vec4(position, 1.0);
  v_position = world.xyz;
  v_normal = transpose(inverse(mat3(model))) * normal;
  v_uv = uv;
  gl_Position = view.projection * world;
}
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

REFLECTANCE = """
float table_at(sampler2D table, int row, float column)
{
  int last = textureSize(table, 0).x - 1;
  float place = clamp(column, 0.0, 1.0) * float(last);
  int low = min(int(place), last - 1);
  float first = texelFetch(table, ivec2(low, row), 0).r;
  return mix(first, texelFetch(table, ivec2(low + 1, row), 0).r, place - float(low));
}

/* Directional albedo of GGX (x) and its average over the directions (y). */
vec2 lobe_albedo(float roughness, float cosine)
{
  int last = textureSize(albedo_table, 0).x - 1;
  float place = roughness * float(last);
  int low = min(int(place), last - 1);
  float directional = mix(table_at(albedo_table, low, cosine), table_at(albedo_table, low + 1, cosine),
                          place - float(low));
  return vec2(directional, table_at(albedo_table, last + 1, roughness));
}

/* Where between f0 and 1 the albedo of a dielectric lies; the rows are those of all roughnesses and cosines. */
float dielectric_share(float roughness, float cosine, float ior)
{
  int last = textureSize(blend_table, 0).x - 1;
  vec2 place = clamp(vec2(roughness, cosine), 0.0, 1.0) * float(last);
  ivec2 low = min(ivec2(place), ivec2(last - 1));
  vec2 share = place - vec2(low);
  float coordinate = sqrt(abs((ior - 1.0) / (ior + 1.0)));
  int row = low.x * (last + 1) + low.y;
  float first = mix(table_at(blend_table, row, coordinate), table_at(blend_table, row + 1, coordinate), share.y);
  row += last + 1;
  return mix(first,
             mix(table_at(blend_table, row, coordinate), table_at(blend_table, row + 1, coordinate), share.y),
             share.x);
}

vec3 multiple_scattering(vec3 mean, vec2 albedo)
{
  if (look.data[0].y < 0.5) {
    return vec3(1.0);
  }
  vec3 scattered = mean * albedo.y / (1.0 - mean * (1.0 - albedo.y));
  return 1.0 + scattered * ((1.0 - albedo.x) / albedo.x);
}

struct Lobe {
  vec3 f0;
  vec3 f90;
  vec3 dip;
  vec3 dielectric;
  vec3 diffuse;
  float ior;
};

void add_metal(inout Lobe lobe, vec3 color, float share, vec2 albedo)
{
  vec3 f0 = min(color, vec3(1.0));
  vec3 tint = clamp(look.data[2].xyz, vec3(0.0), vec3(1.0));
  float low = pow(6.0 / 7.0, 5.0);
  vec3 dip = (f0 + (1.0 - f0) * low) * (1.0 - tint) * 7.0 / (low * 6.0 / 7.0);
  vec3 factor = share * multiple_scattering(f0 + (1.0 - f0) / 21.0 - dip / 126.0, albedo);
  lobe.f0 += factor * f0;
  lobe.f90 += factor;
  lobe.dip += factor * dip;
}

void add_dielectric(inout Lobe lobe, vec3 color, float share, float ior, float roughness, float cosine, vec2 albedo)
{
  float level = look.data[2].w;
  float f0 = pow((ior - 1.0) / (ior + 1.0), 2.0) * 2.0 * max(level, 0.0);
  float root = sqrt(min(f0, 0.99));
  float used = level == 0.5 ? ior : (1.0 + root) / (1.0 - root);
  float plain = pow((used - 1.0) / (used + 1.0), 2.0);
  vec3 tinted = clamp(f0 * max(look.data[2].xyz, vec3(0.0)), vec3(0.0), vec3(1.0));
  float average = (used - 1.0) / (4.08567 + 1.00071 * used);
  vec3 mean = tinted + (1.0 - tinted) * clamp((average - plain) / (1.0 - plain), 0.0, 1.0);
  vec3 factor = multiple_scattering(mean, albedo);
  vec3 reflected = tinted + (1.0 - tinted) * dielectric_share(roughness, cosine, used);
  reflected *= look.data[0].y < 0.5 ? vec3(1.0) : factor * albedo.x;
  float left = clamp(1.0 - max(max(reflected.r, reflected.g), reflected.b), 0.0, 1.0);
  /* What the transmission reflects has the same lobe; its light goes through and is not seen. */
  float through = look.data[1].w;
  vec3 constant_part = (tinted - plain) / (1.0 - plain) * factor * share;
  lobe.f0 += constant_part;
  lobe.f90 += constant_part;
  lobe.dielectric += (1.0 - tinted) / (1.0 - plain) * factor * share;
  lobe.diffuse += color * share * (1.0 - through) * left;
  lobe.ior = max(used, 1.0);
}

Lobe lobe_of_look(vec3 color, float roughness, float metallic, float ior, float cosine)
{
  Lobe lobe = Lobe(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0), 1.5);
  int kind = int(look.data[0].x + 0.5);
  vec2 albedo = lobe_albedo(roughness, cosine);
  if (kind == PRINCIPLED) {
    if (metallic > 0.0) {
      add_metal(lobe, color, metallic, albedo);
    }
    add_dielectric(lobe, color, 1.0 - metallic, ior, roughness, cosine, albedo);
  }
  else if (kind == METAL) {
    add_metal(lobe, color, 1.0, albedo);
  }
  else if (kind == GLOSSY) {
    lobe.f0 = color * multiple_scattering(color, albedo);
    lobe.f90 = lobe.f0;
  }
  else if (kind == GLASS) {
    lobe.dielectric = color;
    lobe.ior = max(ior, 1.0);
  }
  else if (kind == CONDUCTOR || kind == CONDUCTOR_4_5) {
    vec3 factor = multiple_scattering(look.data[FIRST_TERM + 4].xyz, albedo);
    lobe.f0 = factor * look.data[FIRST_TERM].xyz;
    lobe.f90 = factor * look.data[FIRST_TERM + 1].xyz;
    lobe.dip = factor * look.data[FIRST_TERM + 2].xyz;
    lobe.dielectric = factor * look.data[FIRST_TERM + 3].xyz;
  }
  else {
    lobe.diffuse = color;
  }
  return lobe;
}
"""

NORMALS = """
/* Normal of a tangent space normal map; tangents follow from the derivatives of position and UV. */
vec3 mapped_normal(vec3 normal, bool backfacing)
{
  vec3 along_x = dFdx(v_position);
  vec3 along_y = dFdy(v_position);
  vec2 uv_x = dFdx(v_uv);
  vec2 uv_y = dFdy(v_uv);
  vec3 towards_u = along_x * uv_y.y - along_y * uv_x.y;
  vec3 towards_v = along_y * uv_x.x - along_x * uv_y.x;
  float turn = uv_x.x * uv_y.y - uv_x.y * uv_y.x;
  if (turn == 0.0) {
    return normal;
  }
  vec3 smooth_normal = backfacing ? -normal : normal;
  towards_u *= sign(turn);
  towards_v *= sign(turn);
  vec3 tangent = normalize(towards_u - dot(towards_u, smooth_normal) * smooth_normal);
  vec3 bitangent = cross(smooth_normal, tangent);
  bitangent *= dot(bitangent, towards_v) < 0.0 ? -1.0 : 1.0;
  vec3 color = 2.0 * slot_value(normal_image, 4, v_uv) - 1.0;
  float strength = look.data[0].w;
  color = vec3(color.xy * strength, mix(1.0, color.z, clamp(strength, 0.0, 1.0)));
  vec3 bent = normalize(color.x * tangent + color.y * bitangent + color.z * smooth_normal);
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

FRAGMENT = """
void main()
{
  bool backfacing = gl_FrontFacing == (receiver_and_side.y < 0.0);
  vec3 towards_eye = view.eye.w < 0.5 ? view.eye.xyz : normalize(view.eye.xyz - v_position);
  vec3 smooth_normal = normalize(v_normal) * (backfacing ? -1.0 : 1.0);
  vec3 true_normal = normalize(cross(dFdx(v_position), dFdy(v_position)));
  true_normal *= dot(true_normal, towards_eye) < 0.0 ? -1.0 : 1.0;
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
"""

FRAGMENT_OF_SURFACES = """
  vec3 color = max(slot_value(color_image, 0, v_uv), vec3(0.0));
  float roughness = clamp(slot_value(roughness_image, 1, v_uv).x, 0.0, 1.0);
  float metallic = clamp(slot_value(metallic_image, 2, v_uv).x, 0.0, 1.0);
  float ior = max(slot_value(ior_image, 3, v_uv).x, 1.0);
  float cosine = clamp(dot(specular_normal, towards_eye), 0.0, 1.0);
  Lobe lobe = lobe_of_look(color, roughness, metallic, ior, cosine);
  out_position = vec4(v_position, 1.0 + receiver_and_side.x);
  out_normal = vec4(specular_normal, roughness);
  out_base = vec4(lobe.diffuse, lobe.ior);
  out_f0 = vec4(lobe.f0, lobe.dip.r);
  out_f90 = vec4(lobe.f90, lobe.dip.g);
  out_dielectric = vec4(lobe.dielectric, lobe.dip.b);
}
"""

FRAGMENT_OF_NORMALS = """
  if (int(look.data[0].x + 0.5) == TRANSLUCENT) {
    diffuse_normal = -specular_normal;
    smooth_normal = -smooth_normal;
  }
  out_diffuse_normal = vec4(diffuse_normal, alpha2);
  out_smooth_normal = vec4(smooth_normal, 0.0);
}
"""
