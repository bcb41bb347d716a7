/* The lobe of a look with Cycles' weights, as `cycles.closures` computes it for samples. */

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

/* The place of a dielectric's albedo between f0 and 1. The rows of the table are pairs of roughness and cosine. */
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

vec3 scattering_boost(vec3 mean, vec2 albedo)
{
  vec3 scattered = mean * albedo.y / (1.0 - mean * (1.0 - albedo.y));
  return 1.0 + scattered * ((1.0 - albedo.x) / albedo.x);
}

vec3 multiple_scattering(vec3 mean, vec2 albedo)
{
  return look.data[0].y < 0.5 ? vec3(1.0) : scattering_boost(mean, albedo);
}

float dielectric_average(float ior)
{
  float below = 0.997118 + ior * (0.1014 - ior * (0.965241 + ior * 0.130607));
  return ior < 1.0 ? below : (ior - 1.0) / (AVERAGE_START + AVERAGE_SLOPE * ior);
}

float fresnel_of_dielectric(float cosine, float ior)
{
  float g = ior * ior - 1.0 + cosine * cosine;
  if (g <= 0.0) {
    return 1.0;
  }
  g = sqrt(g);
  float a = (g - cosine) / (g + cosine);
  float b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0);
  return 0.5 * a * a * (1.0 + b * b);
}

/* Albedo, a and b of sheen, and the albedo of velvet. */
vec4 sheen_at(float cosine, float roughness)
{
  int last = textureSize(sheen_table, 0).x - 1;
  vec2 place = vec2(max(roughness, 1e-3), cosine) * float(last);
  ivec2 low = min(ivec2(place), ivec2(last - 1));
  vec2 share = place - vec2(low);
  vec4 first = mix(texelFetch(sheen_table, low, 0), texelFetch(sheen_table, low + ivec2(1, 0), 0), share.x);
  vec4 second = mix(texelFetch(sheen_table, low + ivec2(0, 1), 0), texelFetch(sheen_table, low + ivec2(1, 1), 0), share.x);
  return mix(first, second, share.y);
}

/* The value of a Fresnel or Layer Weight node. `factor` is its kind (0: no node, value 1), its parameter, and whether
   the result is 1 minus the value. */
float view_factor(vec3 factor, float cosine, bool backfacing)
{
  if (factor.x < 0.5) {
    return 1.0;
  }
  float share = factor.x < 1.5 ? fresnel_of_dielectric(cosine, backfacing ? 1.0 / factor.y : factor.y)
                               : 1.0 - pow(max(cosine, 1e-20), factor.y);
  return factor.z > 0.5 ? 1.0 - share : share;
}

/* The share of a lobe that is left under its coat, for the cosine of view and the coat's normal. */
vec3 left_under_coat(float cosine)
{
  float weight = look.data[LAYERS].y;
  float roughness = look.data[LAYERS].z;
  float ior = look.data[LAYERS].w;
  vec2 albedo = lobe_albedo(roughness, cosine);
  float f0 = pow((ior - 1.0) / (ior + 1.0), 2.0);
  float reflected = f0 + (1.0 - f0) * dielectric_share(roughness, cosine, ior);
  reflected *= albedo.x * scattering_boost(vec3(dielectric_average(ior)), albedo).x;
  float left = clamp(1.0 - weight * (ior > 1.0 ? reflected : 0.0), 0.0, 1.0);
  /* The light crosses the coat along the refracted ray. */
  float depth = inversesqrt(max(1.0 - (1.0 - cosine * cosine) / (ior * ior), 1e-6));
  vec3 tint = pow(max(look.data[LAYERS + 1].xyz, vec3(1e-20)), vec3(depth));
  return left * (1.0 + weight * (tint - 1.0));
}

/* Both alphas of a lobe. */
vec2 brushed_alphas(float roughness)
{
  vec4 brush = look.data[LAYERS + 4];
  float alpha = roughness * roughness;
  return brush.z < 0.5 ? vec2(alpha) : min(vec2(alpha / brush.x, alpha * brush.x), vec2(1.0));
}

float mean_roughness(vec2 alphas)
{
  return sqrt(sqrt(alphas.x * alphas.y));
}

struct Lobe {
  vec3 f0;
  vec3 f90;
  vec3 dip;
  vec3 dielectric;
  vec3 diffuse;
  float ior;
  float roughness;
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
  float root = sqrt(min(f0, MAX_F0));
  float scaled = (1.0 + root) / (1.0 - root);
  float used = level == 0.5 ? ior : (ior < 1.0 ? 1.0 / scaled : scaled);
  float plain = pow((used - 1.0) / (used + 1.0), 2.0);
  vec3 tinted = clamp(f0 * max(look.data[2].xyz, vec3(0.0)), vec3(0.0), vec3(1.0));
  float average = dielectric_average(used);
  vec3 mean = tinted + (1.0 - tinted) * clamp((average - plain) / (1.0 - plain), 0.0, 1.0);
  vec3 factor = multiple_scattering(mean, albedo);
  vec3 reflected = tinted + (1.0 - tinted) * dielectric_share(roughness, cosine, used);
  reflected *= look.data[0].y < 0.5 ? vec3(1.0) : factor * albedo.x;
  float left = clamp(1.0 - max(max(reflected.r, reflected.g), reflected.b), 0.0, 1.0);
  /* The reflection of the transmission has the same lobe. Transmitted light itself is not seen. */
  float through = look.data[1].w;
  vec3 constant_part = (tinted - plain) / (1.0 - plain) * factor * share;
  lobe.f0 += constant_part;
  lobe.f90 += constant_part;
  lobe.dielectric += (1.0 - tinted) / (1.0 - plain) * factor * share;
  lobe.diffuse += color * share * (1.0 - through) * left;
  lobe.ior = used;
}

Lobe lobe_of_look(vec3 color, float roughness, float metallic, float ior, float cosine)
{
  Lobe lobe = Lobe(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0), 1.5, roughness);
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
    lobe.ior = ior;
  }
  else if (kind == CONDUCTOR || kind == CONDUCTOR_4_5) {
    vec3 factor = multiple_scattering(look.data[FIRST_TERM + 4].xyz, albedo);
    lobe.f0 = factor * look.data[FIRST_TERM].xyz;
    lobe.f90 = factor * look.data[FIRST_TERM + 1].xyz;
    lobe.dip = factor * look.data[FIRST_TERM + 2].xyz;
    lobe.dielectric = factor * look.data[FIRST_TERM + 3].xyz;
  }
  else if (kind == COAT) {
    lobe.dielectric = look.data[LAYERS].y * scattering_boost(vec3(dielectric_average(ior)), albedo);
    lobe.ior = max(ior, 1.0);
  }
  else if (kind == SHEEN) {
    vec4 fuzz = sheen_at(cosine, roughness);
    lobe.diffuse = color * max(fuzz.x, 0.0);
    /* The layout of `GBufferTextures` for sheen. */
    lobe.ior = -max(fuzz.y, 1e-6);
    lobe.roughness = fuzz.z;
  }
  else if (kind != REFRACTION && kind != FILTER) {
    lobe.diffuse = color;
  }
  return lobe;
}

/* The share of light from behind that is seen: it crosses the surface twice, on its way in and on its way out, but that
   of a filter once. */
vec3 let_through(vec3 color, float metallic, float ior, float cosine)
{
  int kind = int(look.data[0].x + 0.5);
  bool principled = kind == PRINCIPLED;
  float share = look.data[1].w * (principled ? 1.0 - metallic : 1.0);
  float left = kind == REFRACTION || kind == FILTER ? 1.0 : 1.0 - fresnel_of_dielectric(cosine, ior);
  return share * left * left * (principled || kind == FILTER ? color : color * color);
}
