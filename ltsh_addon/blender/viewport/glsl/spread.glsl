/* Parts of lights in their planes, cut by disks: `PolygonInDisks` of `light_profile`. */

/* A part of a light, in coordinates of its plane with the foot of the point as the origin: number of corners, least and
   largest distance from the foot, whether it contains the foot, and the direction toward its nearest point. The corners
   are a separate variable, because compilers take minutes for structures that hold arrays. */
vec2 ltsh_corners[LTSH_MOST_CORNERS];
struct ltsh_part { int count; float least; float largest; bool encloses; vec2 forward; };
/* The resolution of the quadrature over a light: layers and the texel of their nodes, chords per arc, and the texel and
   number of corners. */
struct ltsh_effort { int layers; int nodes; int chords; int first; int count; };
/* An edge and a disk: the part inside the disk as shares `first` to `last` of the edge, and the angles from `forward`
   of the ends of the edge (`start`, `end`) and of this part (`entry`, `leave`). */
struct ltsh_cut { float first; float last; float start; float entry; float leave; float end; };

float ltsh_cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

/* The factor of the falloff (power, smoothing) for a squared distance. */
float ltsh_falloff(vec2 falloff, float squared)
{
    float power = falloff.x < 0.5 ? 1.0 : (falloff.x < 1.5 ? sqrt(squared) : squared);
    return power * (falloff.y > 0.0 ? squared / (squared + falloff.y) : 1.0);
}

/* The profile of a light at a radius, as in `light_profile`; `ltsh_descent` is its negative derivative. */
float ltsh_profile(vec4 cone, vec2 falloff, float radius, float distance)
{
    return max((cone.x - radius / distance) * cone.y, 0.0) * ltsh_falloff(falloff, distance * distance + radius * radius);
}

/* The least and the greatest value of the profile within the circle around the light. */
vec2 ltsh_range_of_profile(ltsh_light light, int header)
{
    vec4 cone = ltsh_light_texel(header + 5);
    vec2 falloff = ltsh_light_texel(header + 6).xy;
    float distance = max(-dot(light.offset, light.direction), 1e-30);
    float squared = distance * distance;
    float beside = sqrt(max(dot(light.offset, light.offset) - squared, 0.0));
    vec3 sum = light.half_u + light.half_v;
    vec3 difference = light.half_u - light.half_v;
    float radius = sqrt(max(dot(sum, sum), dot(difference, difference)));
    float near = max(beside - radius, 0.0);
    float far = beside + radius;
    vec2 spread = max((vec2(cone.x) - vec2(far, near) / distance) * cone.y, vec2(0.0));
    return spread * vec2(ltsh_falloff(falloff, squared + near * near), ltsh_falloff(falloff, squared + far * far));
}

float ltsh_descent(vec4 cone, vec2 falloff, float radius, float distance)
{
    float squared = max(distance * distance + radius * radius, 1e-30);
    float share = falloff.x / squared;
    share += falloff.y > 0.0 ? 2.0 * falloff.y / (squared * (falloff.y + squared)) : 0.0;
    float rise = max((cone.x - radius / distance) * cone.y, 0.0) * radius * share;
    return ltsh_falloff(falloff, squared) * (cone.y / distance - rise);
}

ltsh_effort ltsh_effort_of(ltsh_light light, vec2 falloff, float width, float extent, float reach, float beside)
{
    bool fades = falloff.x > 0.0 || falloff.y > 0.0;
    bool inside = extent < LTSH_WELL_INSIDE * (fades ? min(reach - beside, length(light.offset)) : reach - beside);
    bool sharpest = width < LTSH_SHARP_LOBE;
    bool sharp = width < LTSH_WIDE_LOBE && !inside;
    ltsh_effort effort;
    effort.layers = inside && !sharpest ? LTSH_FEW_LAYERS : LTSH_MANY_LAYERS;
    effort.nodes = inside && !sharpest ? LTSH_FEW_NODES : LTSH_MANY_NODES;
    effort.chords = sharpest ? LTSH_SHARPEST_CHORDS : (sharp ? LTSH_SHARP_CHORDS : LTSH_CHORDS);
    effort.first = light.first;
    effort.count = light.count;
    if (light.is_round) {
        bool many = effort.chords > 2;
        effort.first = many ? LTSH_MANY_CORNERS_FIRST : LTSH_FEW_CORNERS_FIRST;
        effort.count = many ? LTSH_MANY_CORNERS : LTSH_FEW_CORNERS;
        effort.chords = 2;
    }
    return effort;
}

/* The convex part where height + s * height_u + t * height_v is positive; corners are s, t. */
ltsh_part ltsh_above(ltsh_part part, float height, float height_u, float height_v)
{
    int kept = 0;
    vec2 previous = ltsh_corners[max(part.count - 1, 0)];
    float previous_height = height + previous.x * height_u + previous.y * height_v;
    vec2 current = ltsh_corners[0];
    for (int i = 0; i < part.count; ++i) {
        float current_height = height + current.x * height_u + current.y * height_v;
        /* Read the next corner first, since up to two corners are written below. */
        vec2 next = ltsh_corners[min(i + 1, part.count - 1)];
        if ((previous_height > 0.0) != (current_height > 0.0)) {
            float share = previous_height / (previous_height - current_height);
            ltsh_corners[min(kept, LTSH_MOST_CORNERS - 1)] = previous + share * (current - previous);
            ++kept;
        }
        if (current_height > 0.0) {
            ltsh_corners[min(kept, LTSH_MOST_CORNERS - 1)] = current;
            ++kept;
        }
        previous = current;
        previous_height = current_height;
        current = next;
    }
    part.count = min(kept, LTSH_MOST_CORNERS);
    return part;
}

/* The part with its distances from the foot, `encloses` and `forward`. */
ltsh_part ltsh_measured(ltsh_part part)
{
    part.largest = 0.0;
    for (int i = 0; i < part.count; ++i) {
        part.largest = max(part.largest, dot(ltsh_corners[i], ltsh_corners[i]));
    }
    bool left = true;
    bool right = true;
    bool has_sides = false;
    float least = 1e37;
    vec2 nearest = vec2(0.0);
    for (int i = 0; i < part.count; ++i) {
        vec2 start = ltsh_corners[i];
        vec2 along = ltsh_corners[i + 1 < part.count ? i + 1 : 0] - start;
        float squared = dot(along, along);
        /* An edge so short that only rounding separates its corners has no sides. */
        bool has_side = squared > 1.2e-7 * part.largest;
        float side = ltsh_cross2(start, along);
        left = left && (side >= 0.0 || !has_side);
        right = right && (side <= 0.0 || !has_side);
        has_sides = has_sides || has_side;
        vec2 place = start + clamp(-dot(start, along) / max(squared, 1e-37), 0.0, 1.0) * along;
        bool nearer = dot(place, place) < least;
        least = nearer ? dot(place, place) : least;
        nearest = nearer ? place : nearest;
    }
    part.largest = sqrt(part.largest);
    part.encloses = has_sides && (left || right);
    float size = sqrt(least);
    part.least = part.encloses ? 0.0 : size;
    part.forward = size > 0.0 ? nearest / size : vec2(1.0, 0.0);
    return part;
}

float ltsh_angle(ltsh_part part, vec2 place)
{
    return atan(ltsh_cross2(part.forward, place), dot(part.forward, place));
}

ltsh_cut ltsh_cut_of(ltsh_part part, int i, float radius)
{
    vec2 start = ltsh_corners[i];
    vec2 end = ltsh_corners[i + 1 < part.count ? i + 1 : 0];
    vec2 along = end - start;
    float squared = dot(along, along);
    squared = squared > 0.0 ? squared : 1.0;
    float side = ltsh_cross2(start, along);
    float middle = -dot(start, along);
    float root = sqrt(max(squared * radius * radius - side * side, 0.0));
    ltsh_cut edge;
    edge.first = clamp((middle - root) / squared, 0.0, 1.0);
    edge.last = clamp((middle + root) / squared, 0.0, 1.0);
    edge.start = ltsh_angle(part, start);
    edge.entry = ltsh_angle(part, start + edge.first * along);
    edge.leave = ltsh_angle(part, start + edge.last * along);
    edge.end = ltsh_angle(part, end);
    return edge;
}

/* Corner number k of `chords` chords that enclose the area of the arc from `start` to `end`. */
vec2 ltsh_arc_corner(ltsh_part part, float start, float end, float size, int chords, int k)
{
    float turn = end - start;
    turn -= abs(turn) > LTSH_PI ? (turn > 0.0 ? 2.0 * LTSH_PI : -2.0 * LTSH_PI) : 0.0;
    float turn_of_one = turn / float(chords);
    float sine = sin(turn_of_one);
    float more = float(chords - 2);
    float total = float(chords) * (sine == 0.0 ? 1.0 : turn_of_one / sine);
    float beyond = chords == 2 ? 0.5 * total : (sqrt(1.0 + more * total) - 1.0) / max(more, 1.0);
    float distance = k == 0 || k == chords ? size : size * beyond;
    float angle = start + float(k) * turn_of_one;
    vec2 across = vec2(-part.forward.y, part.forward.x);
    return distance * (cos(angle) * part.forward + sin(angle) * across);
}

float ltsh_asinh(float x) { return (x < 0.0 ? -1.0 : 1.0) * log(abs(x) + sqrt(x * x + 1.0)); }
