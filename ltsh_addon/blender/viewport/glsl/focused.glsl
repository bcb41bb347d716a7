/* The integral of a lobe over a light with a spread or a falloff, as in `light_profile`, node by node.

   The part of the light above all horizons is kept as a list of corners, since every disk around the foot of the point
   cuts it anew. Edges outside of a disk are moved along radii to its circle, and arcs become chords. */
vec4 @name@_focused(@name@_lobe lobe, @ARGUMENTS@ltsh_light light, int header, float width, bool used)
{
    vec4 cone = ltsh_light_texel(header + 5);
    vec2 falloff = ltsh_light_texel(header + 6).xy;
    float distance = max(-dot(light.offset, light.direction), 1e-30);
    float reach = cone.x * distance;
    vec2 extent = vec2(length(light.half_u), length(light.half_v));
    vec3 axis_u = light.half_u / max(extent.x, 1e-37);
    vec3 axis_v = cross(light.direction, axis_u);
    vec2 center = vec2(dot(light.offset, axis_u), dot(light.offset, axis_v));
    vec2 flat_v = vec2(dot(light.half_v, axis_u), dot(light.half_v, axis_v));
    float beside = length(center);
    float radius_of_light = LTSH_ROUND_MARGIN * length(extent);
    ltsh_effort effort = ltsh_effort_of(light, falloff, width, radius_of_light, reach, beside);

    ltsh_part part;
    part.count = used && beside < reach + radius_of_light ? effort.count : 0;
    for (int i = 0; i < part.count; ++i) {
        ltsh_corners[i] = ltsh_corner(effort.first + i);
    }
    vec3 foot = -distance * @name@_warped(lobe, light.direction);
    vec3 height = @name@_heights(lobe, light.offset, @name@_warped(lobe, light.offset), 1.0);
    vec3 height_u = @name@_heights(lobe, light.half_u, @name@_warped(lobe, light.half_u), 0.0);
    vec3 height_v = @name@_heights(lobe, light.half_v, @name@_warped(lobe, light.half_v), 0.0);
    part = ltsh_above(part, height.x, height_u.x, height_v.x);
    part = ltsh_above(part, height.y, height_u.y, height_v.y);
    part = ltsh_above(part, height.z, height_u.z, height_v.z);
    for (int i = 0; i < part.count; ++i) {
        vec2 place = ltsh_corners[i];
        ltsh_corners[i] = center + place.x * vec2(extent.x, 0.0) + place.y * flat_v;
    }
    part = ltsh_measured(part);

    /* The point of the light's plane at the peak of the lobe, and the width of the lobe there. */
    vec3 warped_u = @name@_warped(lobe, axis_u);
    vec3 warped_v = @name@_warped(lobe, axis_v);
    mat3 to_lobe = @FRAME@;
    vec3 f = to_lobe * foot;
    vec3 u = to_lobe * warped_u;
    vec3 v = to_lobe * warped_v;
    float determinant = u.x * v.y - v.x * u.y;
    bool faces = abs(determinant) > 1e-6 * sqrt(dot(u, u) * dot(v, v));
    determinant = faces ? determinant : 1.0;
    vec2 peak = vec2(v.x * f.y - v.y * f.x, u.y * f.x - u.x * f.y) / determinant;
    float peak_height = f.z + peak.x * u.z + peak.y * v.z;
    faces = faces && peak_height > 0.0;
    vec2 nearest = center + clamp(peak - center, -extent, extent);
    vec2 off = peak - nearest;
    float peak_distance = length(nearest);
    vec2 toward = peak_distance > 0.0 ? nearest / peak_distance : nearest;
    vec2 across = vec2(v.y * toward.x - u.y * toward.y, u.x * toward.y - v.x * toward.x);
    float slope = peak_height / determinant;
    float low = part.least;
    float high = min(part.largest, reach);
    float span = high - low;
    float middle = faces ? clamp(peak_distance, low, high) : low;
    float peak_width = faces ? sqrt(slope * slope * dot(across, across) + dot(off, off)) : 1e37;
    peak_width = clamp(peak_width, LTSH_LEAST_WIDTH * span, LTSH_MOST_WIDTH * span);
    float safe_width = peak_width > 0.0 ? peak_width : 1.0;
    float first = ltsh_asinh((low - middle) / safe_width);
    float half_range = 0.5 * (ltsh_asinh((high - middle) / safe_width) - first);

    vec2 pivot = part.least * part.forward;
    vec3 pivot_warped = foot + pivot.x * warped_u + pivot.y * warped_v;
    vec4 values = vec4(0.0);
    bool seen = part.count > 2 && part.least < reach;
    /* After the disks, one more layer for the whole part if the cone contains it. */
    int layers = seen ? effort.layers + (part.largest < reach ? 1 : 0) : 0;
    for (int layer = 0; layer < layers; ++layer) {
        bool all_of_it = layer == effort.layers;
        vec2 node = ltsh_light_texel(effort.nodes + (all_of_it ? 0 : layer)).xy;
        float place = first + half_range * (1.0 + node.x);
        float grown = exp(place);
        float radius = all_of_it ? part.largest : middle + peak_width * 0.5 * (grown - 1.0 / grown);
        float weight = all_of_it ? ltsh_profile(cone, falloff, radius, distance)
                                 : node.y * half_range * peak_width * 0.5 * (grown + 1.0 / grown)
                                       * ltsh_descent(cone, falloff, radius, distance);
        float lowest = 4.0;
        float highest = -4.0;
        for (int i = 0; i < part.count; ++i) {
            ltsh_cut edge = ltsh_cut_of(part, i, radius);
            bool meets = edge.last > edge.first;
            lowest = meets ? min(lowest, min(edge.entry, edge.leave)) : lowest;
            highest = meets ? max(highest, max(edge.entry, edge.leave)) : highest;
        }
        lowest = part.encloses ? -4.0 : lowest;
        highest = part.encloses ? 4.0 : max(lowest, highest);

        vec3 reaching = sqrt(max(radius * radius - part.least * part.least, 0.0)) * (abs(warped_u) + abs(warped_v));
        bool tiny = dot(reaching, reaching) < @TINY@ * dot(pivot_warped, pivot_warped);
        @name@_sum sum = @name@_empty();
        vec3 before = vec3(0.0);
        int per_edge = 2 * effort.chords + 1;
        for (int i = 0; i < part.count; ++i) {
            ltsh_cut edge = ltsh_cut_of(part, i, radius);
            float size = min(length(ltsh_corners[i]), radius);
            float next_size = min(length(ltsh_corners[i + 1 < part.count ? i + 1 : 0]), radius);
            for (int k = 0; k <= per_edge; ++k) {
                bool entering = k <= effort.chords;
                vec2 corner = ltsh_arc_corner(
                    part,
                    clamp(entering ? edge.start : edge.leave, lowest, highest),
                    clamp(entering ? edge.entry : edge.end, lowest, highest),
                    entering ? size : next_size,
                    effort.chords,
                    entering ? k : k - effort.chords - 1
                );
                vec2 moved = corner - pivot;
                vec3 last = moved.x * warped_u + moved.y * warped_v;
                last = tiny ? last : ltsh_unit(pivot_warped + last);
                int edges = k == 0 ? 0 : 1;
                for (int piece = 0; piece < (tiny ? 0 : edges); ++piece) {
                    sum = @name@_with_edge(sum, before, last);
                }
                for (int piece = 0; piece < (tiny ? 3 * edges : 0); ++piece) {
                    sum = @name@_with_third(sum, pivot_warped, before, last, piece);
                }
                before = last;
            }
        }
        values += weight * @VALUE@;
    }
    return values;
}
