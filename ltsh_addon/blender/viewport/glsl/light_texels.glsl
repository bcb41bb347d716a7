vec4 ltsh_light_texel(int index)
{
    return texelFetch(lights, ivec2(index % LTSH_LIGHT_WIDTH, index / LTSH_LIGHT_WIDTH), 0);
}

vec2 ltsh_corner(int texel) { return ltsh_light_texel(texel).xy; }

/* Horizons of normals that are this close meet nowhere in single precision, and count as one. */
bool ltsh_is_same(vec3 a, vec3 b) { return all(lessThan(abs(a - b), vec3(1e-6))); }
