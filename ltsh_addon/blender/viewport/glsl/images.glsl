/* Quantities of a look, from constants and images. The uniform buffer `look` is an array of vec4, see
   `textures.look_values`. Images are read by texelFetch, as Blender 4.5 cannot set a texture's filter and extension. */

int wrapped(int texel, int size, int extension)
{
  if (extension == EXTENSION_REPEAT) {
    int inside = texel % size;
    return inside < 0 ? inside + size : inside;
  }
  if (extension == EXTENSION_MIRROR) {
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

/* A texel of an image. With `encode` as the sRGB value, which Cycles interpolates; with `by_alpha` times its alpha, as
   in Cycles. */
vec4 texel_at(sampler2D image, ivec2 texel, ivec2 size, int extension, bool encode, bool by_alpha)
{
  if (extension == EXTENSION_CLIP && (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, size)))) {
    return vec4(0.0);
  }
  ivec2 place = ivec2(wrapped(texel.x, size.x, extension), wrapped(texel.y, size.y, extension));
  vec4 value = texelFetch(image, place, 0);
  if (encode) {
    value.rgb = vec3(encoded(value.r), encoded(value.g), encoded(value.b)) * (by_alpha ? value.a : 1.0);
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
  int extension = code % EXTENSIONS;
  bool encode = code >= EXTENSIONS;
  bool by_alpha = code >= 2 * EXTENSIONS;
  bool is_closest = row_u.w > 0.5;
  encode = is_closest ? by_alpha : encode;
  ivec2 size = textureSize(image, 0);
  vec2 texel = vec2(dot(row_u.xyz, place), dot(row_v.xyz, place)) * vec2(size) - (is_closest ? 0.0 : 0.5);
  ivec2 corner = ivec2(floor(texel));
  vec2 share = is_closest ? vec2(0.0) : texel - floor(texel);
  vec4 value = vec4(0.0);
  /* Compilers unroll loops of a constant length: this shader would take them a second for each of its outputs. */
  int corners = is_closest ? 1 : 4;
  for (int number = 0; number < corners; number++) {
    ivec2 beside = ivec2(number & 1, number >> 1);
    vec2 weight = mix(1.0 - share, share, vec2(beside));
    value += weight.x * weight.y * texel_at(image, corner + beside, size, extension, encode, by_alpha);
  }
  if (encode) {
    value.rgb = vec3(decoded(value.r), decoded(value.g), decoded(value.b));
  }
  return offset.xyz +
         vec3(dot(look.data[base], value), dot(look.data[base + 1], value), dot(look.data[base + 2], value));
}
