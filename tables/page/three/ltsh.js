/* LTSH in place of LTC for the RectAreaLights of three.js (WebGLRenderer, release 187):

       import { installLTSH } from "./ltsh.js";
       installLTSH();                                     // before the first material is compiled

   All lights and materials stay as they are. The table takes the place of three's two textures. */
import * as THREE from "three";
import { data, header, width } from "./ltsh4.js";

const FUNCTIONS = `
#define LTSH4_DATA(index) texelFetch(ltc_1, ivec2((index) % ${width}, (index) / ${width}), 0).r
${header.replace("#include <math.h>", "")}

/* What a lobe reflects of a light with these corners, relative to the point, for radiance 1. */
vec3 ltsh_reflected(vec3 normal, vec3 view, float roughness, vec3 f0, float f90, vec3 corners[4])
{
    ltsh_frame frame = ltsh_make_frame(normal, view);
    ltsh_polygon light = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        light = ltsh_with_corner(light, ltsh_to_local(frame, corners[i]));
    }
    light = ltsh_clip_to_horizon(light);
    ltsh_cell cell = ltsh4_cell(dot(normal, view), roughness);
    ltsh4_moments moments = ltsh4_polygon_moments(ltsh4_lookup_warp(cell), light);
    float sign = ltsh_orientation(light);
    float plain = ltsh4_plain_integral(ltsh4_moment_weights(ltsh4_lookup_curve(cell, 0)), moments, sign);
    float grazing = max(sign * ltsh4_integral(ltsh4_moment_weights(ltsh4_lookup_curve(cell, 1)), moments), 0.0);
    /* Against bright and dark spots in the tail of the lobe: */
    vec3 center = 0.25 * (corners[0] + corners[1] + corners[2] + corners[3]);
    vec3 half_u = 0.5 * (corners[1] - corners[0]), half_v = 0.5 * (corners[2] - corners[1]);
    ltsh_extent extent = ltsh_extent(center, half_u, half_v, 4.0 * cross(half_u, half_v));
    ltsh_limits limits = ltsh_tail_limits(normal, normal, view, roughness, extent);
    if (plain > 0.0) {
        plain = ltsh_between(plain, limits.least, limits.most);
        grazing = ltsh_between(grazing, 0.0, pow(1.0 - limits.cosine, 5.0) * plain);
    }
    return f0 * plain + (f90 - f0) * grazing;
}

void RE_Direct_RectArea_Physical(const in RectAreaLight rectAreaLight, const in vec3 geometryPosition,
    const in vec3 geometryNormal, const in vec3 geometryViewDir, const in vec3 geometryClearcoatNormal,
    const in PhysicalMaterial material, inout ReflectedLight reflectedLight)
{
    vec3 center = rectAreaLight.position - geometryPosition, u = rectAreaLight.halfWidth, v = rectAreaLight.halfHeight;
    if (dot(center, cross(v, u)) >= 0.0) {
        return; /* behind the light */
    }
    vec3 corners[4] = vec3[4](center + u - v, center - u - v, center - u + v, center + u + v);
    reflectedLight.directSpecular += rectAreaLight.color * ltsh_reflected(geometryNormal, geometryViewDir,
        material.roughness, material.specularColorBlended, material.specularF90, corners);
    ltsh_frame frame = ltsh_make_frame(geometryNormal, geometryViewDir);
    ltsh_polygon light = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        light = ltsh_with_corner(light, ltsh_to_local(frame, corners[i]));
    }
    float form_factor = ltsh_form_factor(ltsh_clip_to_horizon(light));
    reflectedLight.directDiffuse += rectAreaLight.color * material.diffuseContribution * form_factor;
#ifdef USE_CLEARCOAT
    clearcoatSpecularDirect += rectAreaLight.color * ltsh_reflected(geometryClearcoatNormal, geometryViewDir,
        material.clearcoatRoughness, material.clearcoatF0, material.clearcoatF90, corners);
#endif
}
`;

export function installLTSH()
{
    const bits = new Uint16Array(Uint8Array.from(atob(data), letter => letter.charCodeAt(0)).buffer);
    const table = new THREE.DataTexture(bits, width, bits.length / width, THREE.RedFormat, THREE.HalfFloatType);
    table.needsUpdate = true;
    for (const name of ["LTC_FLOAT_1", "LTC_FLOAT_2", "LTC_HALF_1", "LTC_HALF_2"]) {
        THREE.UniformsLib[name] = table;
    }
    const chunk = THREE.ShaderChunk.lights_physical_pars_fragment;
    const start = chunk.indexOf("void RE_Direct_RectArea_Physical");
    const end = chunk.lastIndexOf("#endif", chunk.indexOf("void RE_Direct_Physical", start));
    if (start < 0 || end < start) {
        throw new Error(`three.js ${THREE.REVISION} shades RectAreaLights elsewhere than release 187 does`);
    }
    THREE.ShaderChunk.lights_physical_pars_fragment = chunk.slice(0, start) + FUNCTIONS + chunk.slice(end);
}
