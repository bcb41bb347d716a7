"""The first pass: surfaces of the scene into a G-buffer."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from mathutils import Matrix

from ..materials.looks import IMAGE_SLOTS, is_missing
from .mirror import ShownInstance, ShownLook
from .textures import (
    DEFINES,
    LOOK_SIZE,
    GBufferTextures,
    albedo_table,
    blend_table,
    float_table,
    float_texture,
    uniform_buffer,
)

VERTEX = """
void main()
{
  vec4 world = model * vec4(position, 1.0);
  v_position = world.xyz;
  v_normal = transpose(inverse(mat3(model))) * normal;
  /* A mesh with one user Cycles moves into the world, and there its normals have unit length again. */
  v_normal /= ONLY_USER ? max(length(v_normal), 1e-30) : 1.0;
  v_object_normal = normal;
  v_uv = uv;
  v_tangent = tangent;
  gl_Position = view.projection * world;
}
"""

FRAGMENT = """
void main()
{
  bool backfacing = gl_FrontFacing == (placement.y < 0.0);
  vec3 towards_eye = view.eye.w < 0.5 ? view.eye.xyz : normalize(view.eye.xyz - v_position);
  vec3 smooth_normal = normalize(v_normal) * (backfacing ? -1.0 : 1.0);
  vec3 true_normal = normalize(cross(dFdx(v_position), dFdy(v_position)));
  true_normal *= dot(true_normal, towards_eye) < 0.0 ? -1.0 : 1.0;
  /* Exact where it can be: derivatives are rounded. */
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
"""

FRAGMENT_OF_SURFACES = """
  vec3 color = max(slot_value(color_image, 0, v_uv), vec3(0.0));
  float roughness = clamp(slot_value(roughness_image, 1, v_uv).x, 0.0, 1.0);
  float metallic = clamp(slot_value(metallic_image, 2, v_uv).x, 0.0, 1.0);
  float ior = max(slot_value(ior_image, 3, v_uv).x, 1.0);
  float cosine = clamp(dot(specular_normal, towards_eye), 0.0, 1.0);
  Lobe lobe = lobe_of_look(color, roughness, metallic, ior, cosine);
  vec3 weight = vec3(look.data[LAYERS].x);
  weight *= clamp(slot_value(weight_image, 5, v_uv).x, 0.0, 1.0);
  weight *= view_factor(look.data[LAYERS + 2].xyz, abs(dot(smooth_normal, towards_eye)), backfacing);
  if (look.data[LAYERS].y > 0.0 && int(look.data[0].x + 0.5) != COAT) {
    vec3 coat_normal = specular_normal;
    if (look.data[LAYERS + 1].w < 0.5) {
      coat_normal = flags >= 2 ? valid_specular_normal(smooth_normal, true_normal, towards_eye) : smooth_normal;
    }
    weight *= left_under_coat(clamp(dot(coat_normal, towards_eye), 0.0, 1.0));
  }
  out_position = vec4(v_position, 1.0 + placement.x);
  out_normal = vec4(specular_normal, roughness);
  out_base = vec4(weight * lobe.diffuse, lobe.ior);
  out_f0 = vec4(weight * lobe.f0, weight.r * lobe.dip.r);
  out_f90 = vec4(weight * lobe.f90, weight.g * lobe.dip.g);
  out_dielectric = vec4(weight * lobe.dielectric, weight.b * lobe.dip.b);
  LEAVE_OUT_HIDDEN
}
"""

FRAGMENT_OF_NORMALS = """
  out_geometric_normal = vec4(true_normal, 0.0);
  if (int(look.data[0].x + 0.5) == TRANSLUCENT) {
    diffuse_normal = -specular_normal;
    smooth_normal = -smooth_normal;
  }
  out_diffuse_normal = vec4(diffuse_normal, alpha2);
  out_smooth_normal = vec4(smooth_normal, 0.0);
  LEAVE_OUT_HIDDEN
}
"""

# What is drawn later is drawn where it is the surface of the G-buffer.
SEEN = """
bool is_seen()
{
  vec4 seen = texelFetch(positions, ivec2(gl_FragCoord.xy), 0);
  vec3 between = seen.xyz - v_position;
  float distance2 = view.eye.w < 0.5 ? 1.0 : dot(view.eye.xyz - v_position, view.eye.xyz - v_position);
  return seen.w != 0.0 && dot(between, between) <= 1e-7 * distance2;
}
"""

EMISSION_FRAGMENT = """
void main()
{
  if (!is_seen()) {
    discard;
  }
  out_emission = vec4(look.data[1].xyz, 0.0);
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

NORMALS_TEXT = """
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
  return (ior - 1.0) / (4.08567 + 1.00071 * ior);
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

/* What Fresnel and Layer Weight say: kind (0: 1), number, whether it is taken from 1. */
float view_factor(vec3 factor, float cosine, bool backfacing)
{
  if (factor.x < 0.5) {
    return 1.0;
  }
  float share = factor.x < 1.5 ? fresnel_of_dielectric(cosine, backfacing ? 1.0 / factor.y : factor.y)
                               : 1.0 - pow(max(cosine, 1e-20), factor.y);
  return factor.z > 0.5 ? 1.0 - share : share;
}

/* The share of a lobe that is left under its coat, whose normal is seen under `cosine`. */
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
  float average = dielectric_average(used);
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
  else if (kind == COAT) {
    lobe.dielectric = look.data[LAYERS].y * scattering_boost(vec3(dielectric_average(ior)), albedo);
    lobe.ior = max(ior, 1.0);
  }
  else {
    lobe.diffuse = color;
  }
  return lobe;
}
"""

# No more than six textures can be drawn into at once.
SURFACES = ("position", "normal", "base", "f0", "f90", "dielectric")
NORMALS = ("diffuse_normal", "smooth_normal", "geometric_normal")
EMISSION = ("emission",)
# Before, Cycles left interpolated normals as long as they are.
NORMAL_MAPS_BEND_UNIT_NORMALS = bpy.app.version >= (5, 0, 0)
# That of images which are not found, as in Cycles.
MISSING_COLOR = (1.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class View:
    """From where a picture is seen: matrices (4, 4), and the eye's place or, in parallel views, the way to it."""

    projection: np.ndarray  # world to clip space
    eye: np.ndarray  # (3,)
    is_parallel: bool

    @classmethod
    def of(cls, view_matrix: Matrix, window_matrix: Matrix, is_parallel: bool) -> View:
        """That of a region's matrices."""
        to_world = view_matrix.inverted()
        eye = to_world.col[2].xyz.normalized() if is_parallel else to_world.translation
        return cls(np.array(window_matrix @ view_matrix, np.float64), np.array(eye), is_parallel)


class SurfacePass:
    """Shaders and textures of one view's G-buffer; needs an active GPU context."""

    def __init__(self):
        self._shaders = {(outputs, False): _shader(outputs) for outputs in (SURFACES, NORMALS, EMISSION)}
        self._tables = {"albedo_table": float_table(albedo_table()), "blend_table": float_table(blend_table())}
        self._nothing = float_texture(np.zeros((1, 1, 4)))
        self._missing = float_texture(np.array(MISSING_COLOR).reshape(1, 1, 4))
        self._size, self._textures, self._buffers = None, {}, {}
        self._lobe_textures: dict = {}

    def draw(self, instances: list[ShownInstance], view: View, size: tuple[int, int]) -> GBufferTextures:
        """The G-buffer of `instances`, `size` pixels wide and high; valid until the next call.

        Normals of their own are there where a surface is smooth or bent.
        """
        self._resize(size)
        textures = dict(self._draw_into(SURFACES, instances, view, size))
        if has_normals(instances):
            textures.update(self._draw_into(NORMALS, instances, view, size))
        return GBufferTextures(**textures)

    def draw_lobe(self, number: int, instances: list[ShownInstance], view: View) -> GBufferTextures:
        """The G-buffer of the lobes `number`, from 1 on, of what `draw` drew last; valid until the next call.

        There is no surface where a material has fewer lobes.
        """
        having = [instance for instance in instances if any(len(look.lobes) > number for look in instance.looks)]
        textures = dict(self._draw_into(SURFACES, having, view, self._size, number))
        if has_normals(having):
            textures.update(self._draw_into(NORMALS, having, view, self._size, number))
        return GBufferTextures(**textures)

    @property
    def depth(self) -> gpu.types.GPUTexture:
        """The depth of what was drawn last."""
        return self._depth

    def add_emission(self, instances: list[ShownInstance], view: View, size: tuple[int, int], frame_buffer) -> None:
        """Add what the surfaces drawn last emit to `frame_buffer`."""
        shining = [instance for instance in instances if any(np.any(look.look.emission) for look in instance.looks)]
        if not shining:
            return
        with frame_buffer.bind():
            gpu.state.viewport_set(0, 0, *size)
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("ADDITIVE_PREMULT")
            try:
                self._draw_instances(self._shaders[EMISSION, False], shining, view, is_emission=True)
            finally:
                gpu.state.blend_set("NONE")

    def free(self) -> None:
        """Let go of everything."""
        self._size, self._textures, self._buffers, self._tables, self._shaders = None, {}, {}, {}, {}
        self._lobe_textures = {}
        self._nothing = self._missing = self._depth = None

    def _resize(self, size) -> None:
        if size == self._size:
            return
        self._textures = {name: gpu.types.GPUTexture(size, format="RGBA32F") for name in (*SURFACES, *NORMALS)}
        self._depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
        self._buffers = {
            outputs: gpu.types.GPUFrameBuffer(
                depth_slot=self._depth, color_slots=[self._textures[name] for name in outputs]
            )
            for outputs in (SURFACES, NORMALS)
        }
        self._lobe_textures = {}
        self._size = size

    def _target(self, outputs, is_further: bool):
        """Textures by name and the frame buffer that `outputs` are drawn into; those of further lobes have no depth."""
        if not is_further:
            return {name: self._textures[name] for name in outputs}, self._buffers[outputs]
        if outputs not in self._lobe_textures:
            textures = {name: gpu.types.GPUTexture(self._size, format="RGBA32F") for name in outputs}
            buffer = gpu.types.GPUFrameBuffer(color_slots=list(textures.values()))
            self._lobe_textures[outputs] = textures, buffer
        return self._lobe_textures[outputs]

    def _draw_into(self, outputs, instances, view: View, size, number: int = 0) -> dict:
        """Draw the lobes `number`; the textures by name."""
        textures, buffer = self._target(outputs, number > 0)
        if (outputs, number > 0) not in self._shaders:
            self._shaders[outputs, True] = _shader(outputs, is_further=True)
        with buffer.bind():
            gpu.state.viewport_set(0, 0, *size)
            # Only the position tells where there is a surface, but no number may be left that is not one.
            if number > 0:
                buffer.clear(color=(0.0, 0.0, 0.0, 0.0))
            else:
                buffer.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("NONE" if number > 0 else "LESS_EQUAL")
            gpu.state.depth_mask_set(number == 0)
            gpu.state.face_culling_set("NONE")
            try:
                self._draw_instances(self._shaders[outputs, number > 0], instances, view, number)
            finally:
                gpu.state.depth_test_set("NONE")
                gpu.state.depth_mask_set(False)
        return textures

    def _draw_instances(self, shader, instances, view: View, number: int = 0, is_emission: bool = False) -> None:
        shader.bind()
        if number > 0 or is_emission:
            shader.uniform_sampler("positions", self._textures["position"])
        values = np.vstack([view.projection.T, [*view.eye, 0.0 if view.is_parallel else 1.0]])
        # Kept until all is drawn: the card reads it then.
        self._view_values = uniform_buffer(values)
        shader.uniform_block("view", self._view_values)
        for name, table in self._tables.items() if not is_emission else ():
            shader.uniform_sampler(name, table)
        # From near to far: what is hidden need not be computed.
        for instance in sorted(instances, key=lambda item: np.dot(view.projection[3], item.center)):
            shader.uniform_float("model", instance.model)
            if not is_emission:
                marks = instance.mesh.is_smooth, instance.is_only_user
                shader.uniform_float("placement", (instance.receiver, instance.side, *marks))
            for slot, look in zip(instance.mesh.slots, instance.looks, strict=True):
                for lobe in look.lobes[number : number + 1]:
                    shader.uniform_block("look", lobe.uniforms)
                    if not is_emission:
                        self._bind_images(shader, lobe)
                    instance.mesh.batch(slot, lobe.look.uv_map).draw(shader)

    def _bind_images(self, shader, shown: ShownLook) -> None:
        if shown.textures is None:
            shown.textures = {
                name: self._missing if is_missing(use.image) else gpu.texture.from_image(use.image)
                for name, use in shown.look.images.items()
            }
        for name in IMAGE_SLOTS:
            shader.uniform_sampler(f"{name}_image", shown.textures.get(name, self._nothing))


def has_normals(instances: list[ShownInstance]) -> bool:
    """True where the diffuse lobe or a horizon has a normal of its own."""
    return has_bent_lobes(instances) or any(instance.mesh.is_smooth for instance in instances)


def has_bent_lobes(instances: list[ShownInstance]) -> bool:
    """True where a diffuse lobe does not end at its own normal's horizon."""
    return any(_bends(lobe) for instance in instances for look in instance.looks for lobe in look.lobes)


def _bends(shown: ShownLook) -> bool:
    """True where the diffuse lobe has a normal of its own."""
    return shown.look.normal is not None or shown.look.kind == "translucent"


def _shader(outputs, is_further: bool = False):
    info = gpu.types.GPUShaderCreateInfo()
    info.typedef_source(
        f"struct SurfaceView {{ mat4 projection; vec4 eye; }};\nstruct SurfaceLook {{ vec4 data[{LOOK_SIZE}]; }};\n"
    )
    for name, value in DEFINES.items():
        info.define(name, value)
    info.uniform_buf(0, "SurfaceView", "view")
    info.uniform_buf(1, "SurfaceLook", "look")
    info.push_constant("MAT4", "model")
    # What a shader does not use is not there for whom sets it.
    if outputs != EMISSION:
        info.push_constant("VEC4", "placement")
    info.define("UNIT_NORMALS", "true" if NORMAL_MAPS_BEND_UNIT_NORMALS else "false")
    info.define("ONLY_USER", "false" if outputs == EMISSION else "(placement.w > 0.0)")
    images = (*(f"{name}_image" for name in IMAGE_SLOTS), "albedo_table", "blend_table")
    needs_seen = is_further or outputs == EMISSION
    for slot, name in enumerate((*(images if outputs != EMISSION else ()), *(("positions",) if needs_seen else ()))):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("LEAVE_OUT_HIDDEN", "if (!is_seen()) { discard; }" if is_further else "")
    info.vertex_in(0, "VEC3", "position")
    info.vertex_in(1, "VEC3", "normal")
    info.vertex_in(2, "VEC2", "uv")
    # Meshes without normal maps have none: they get (0, 0, 0, 1).
    info.vertex_in(3, "VEC4", "tangent")
    passed = gpu.types.GPUStageInterfaceInfo(f"ltsh_{outputs[0]}_{int(is_further)}")
    passed.smooth("VEC3", "v_position")
    passed.smooth("VEC3", "v_normal")
    passed.smooth("VEC3", "v_object_normal")
    passed.smooth("VEC2", "v_uv")
    passed.smooth("VEC4", "v_tangent")
    info.vertex_out(passed)
    for slot, name in enumerate(outputs):
        info.fragment_out(slot, "VEC4", f"out_{name}")
    info.vertex_source(VERTEX)
    info.fragment_source((SEEN if needs_seen else "") + _fragment_source(outputs))
    return gpu.shader.create_from_info(info)


def _fragment_source(outputs) -> str:
    if outputs == EMISSION:
        return EMISSION_FRAGMENT
    end = FRAGMENT_OF_SURFACES if outputs == SURFACES else FRAGMENT_OF_NORMALS
    return IMAGES + REFLECTANCE + NORMALS_TEXT + FRAGMENT + end
