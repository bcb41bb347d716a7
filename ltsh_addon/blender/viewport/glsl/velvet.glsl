/* Ashikhmin's sheen, by quadrature over the triangles between the edges of a light and a direction near its middle. */

/* Set for each light: that direction. */
vec3 ltsh_velvet_apex;

/* `shading.diffuse.velvet_lobe`. */
float ltsh_velvet_lobe(vec3 direction)
{
    float x = dot(ltsh_rough_x, direction);
    float z = max(dot(ltsh_rough_z, direction), 0.0);
    float cosine = ltsh_rough_view.x;
    /* Squared cosines of half the angle between both rays, and of the angle between normal and half vector. */
    float halved = max(0.5 * (1.0 + cosine * z + ltsh_rough_view.y * x), 1e-6);
    float normal = clamp((cosine + z) * (cosine + z) / (4.0 * halved), 0.0, 1.0 - 1e-6);
    float masked = min(1.0, 2.0 * sqrt(normal / halved) * min(cosine, z));
    float spread = ltsh_velvet * ltsh_velvet * (1.0 - normal);
    float density = LTSH_ONE_OVER_PI * exp(-normal / spread) / (spread * (1.0 - normal));
    return density * masked / (4.0 * cosine);
}

void ltsh_set_velvet_apex(ltsh_light light)
{
    /* Between the light's center and its point nearest to the shaded point. */
    float u = clamp(-dot(light.offset, light.half_u) / max(dot(light.half_u, light.half_u), 1e-37), -1.0, 1.0);
    float v = clamp(-dot(light.offset, light.half_v) / max(dot(light.half_v, light.half_v), 1e-37), -1.0, 1.0);
    vec3 near = light.offset + u * light.half_u + v * light.half_v;
    vec3 center = ltsh_unit(ltsh_unit(light.offset) + ltsh_unit(near));
    float height = dot(ltsh_rough_z, center);
    ltsh_velvet_apex = ltsh_unit(center + (max(height, 0.05) - height) * ltsh_rough_z);
}

float ltsh_velvet_triangle(vec3 start, vec3 end)
{
    float volume = dot(ltsh_velvet_apex, cross(start - ltsh_velvet_apex, end - ltsh_velvet_apex));
    vec4 nodes = LTSH_ARC_PLACES;
    vec4 weights = LTSH_ARC_WEIGHTS;
    float sum = 0.0;
    int count = ltsh_velvet > 0.0 ? LTSH_ARC_NODES * LTSH_ARC_NODES : 0;
    for (int k = 0; k < count; ++k) {
        int row = k / LTSH_ARC_NODES;
        int column = k % LTSH_ARC_NODES;
        float away = 0.5 + (row % 2 == 0 ? 0.5 : -0.5) * nodes[row / 2];
        float along = 0.5 + (column % 2 == 0 ? 0.5 : -0.5) * nodes[column / 2];
        vec3 node = ltsh_velvet_apex + away * (start - ltsh_velvet_apex + along * (end - start));
        float inverse = inversesqrt(max(dot(node, node), 1e-30));
        float weight = 0.25 * weights[row / 2] * weights[column / 2] * away * inverse * inverse * inverse;
        sum += weight * ltsh_velvet_lobe(inverse * node);
    }
    return volume * sum;
}

/* The integral over the triangle of an edge; long edges are divided into four. */
float ltsh_velvet_edge(vec3 start, vec3 end)
{
    bool is_long = dot(start, end) < 0.6;
    vec3 middle = ltsh_unit(start + end);
    vec3 before = start;
    float sum = 0.0;
    int piece = 0;
    do {
        vec3 from = piece < 2 ? start : middle;
        vec3 to = piece < 2 ? middle : end;
        vec3 next = is_long ? (piece % 2 == 0 ? ltsh_unit(from + to) : to) : end;
        sum += ltsh_velvet_triangle(before, next);
        before = next;
    } while (++piece < (is_long ? 4 : 1));
    return sum;
}
