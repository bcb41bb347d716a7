struct Scene { eye: vec4f, center: vec4f, half_u: vec4f, half_v: vec4f }
@group(0) @binding(0) var<storage, read> table: array<f32>;
@group(0) @binding(1) var<storage, read> surfaces: array<vec4f>; // four pictures, see surfaces.glsl
@group(0) @binding(2) var<uniform> scene: Scene;
@group(0) @binding(3) var<storage, read_write> picture: array<vec4f>;
fn @prefix@_data(index: i32) -> f32 { return table[index]; }
@HEADER@
@compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3u)
{
    let count = arrayLength(&picture);
    if (id.x >= count) {
        return;
    }
    let position = surfaces[id.x];
    let normal = surfaces[id.x + count].xyz;
    let f0 = surfaces[id.x + 2u * count].xyz;
    let albedo = surfaces[id.x + 3u * count].xyz;
    let center = scene.center.xyz - position.xyz;
    let half_u = scene.half_u.xyz;
    let half_v = scene.half_v.xyz;
    let area = 4.0 * cross(half_u, half_v);
    picture[id.x] = vec4f(0.0, 0.0, 0.0, select(1.0, -1.0, position.w < 0.0));
    if (position.w < 0.0 || dot(center, area) >= 0.0) {
        return;
    }
    let view = normalize(scene.eye.xyz - position.xyz);
    let frame = ltsh_make_frame(normal, view);
    var polygon = ltsh_empty_polygon();
    polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, center - half_u - half_v));
    polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, center + half_u - half_v));
    polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, center + half_u + half_v));
    polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, center - half_u + half_v));
    polygon = ltsh_clip_to_horizon(polygon);

    let cell = @prefix@_cell(dot(normal, view), position.w);
    let moments = @prefix@_polygon_moments(@prefix@_lookup_warp(cell), polygon);
    let facing = ltsh_orientation(polygon);
    var plain = @prefix@_plain_integral(@prefix@_moment_weights(@prefix@_lookup_curve(cell, 0)), moments, facing);
    var grazing = max(facing * @prefix@_integral(@prefix@_moment_weights(@prefix@_lookup_curve(cell, 1)), moments), 0.0);
@LIMITS@
    var specular = f0 * plain + (vec3f(1.0) - f0) * grazing;
    if (dot(normal, view) <= 0.0) {
        specular = vec3f(0.0);
    }
    picture[id.x] = vec4f(@RADIANCE@ * (specular + albedo * ltsh_form_factor(polygon)), 1.0);
}
