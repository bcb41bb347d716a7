/* Moments of a polygon. The first, the solid angle, lacks twice the argument of the complex number `turn`. */
struct specular_sum { float values[LTSH_COEFFICIENTS]; vec2 turn; };

specular_sum specular_empty()
{
    specular_sum sum;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        sum.values[k] = 0.0;
    }
    sum.turn = vec2(1.0, 0.0);
    return sum;
}

specular_sum specular_with_edge(specular_sum moments, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    vec2 turn = vec2(edge.total.z + ltsh_one_plus_cosine(edge.total), edge.normal.z);
    turn = vec2(moments.turn.x * turn.x - moments.turn.y * turn.y, moments.turn.x * turn.y + moments.turn.y * turn.x);
    /* Only the argument matters: keep the magnitude near one. */
    float magnitude = abs(turn.x) + abs(turn.y);
    moments.turn = magnitude > 0.0 ? turn / magnitude : moments.turn;
@MOMENT_LINES@
    return moments;
}

/* The integrand of the moment k. Where an edge adds K_{n-1} of `edge_integrals`, it is
   (n + 1) x^n - (n - 1) |u|^2 x^(n-2). */
float ltsh_spot_moment(vec3 direction, float u_x, float u_z, int k)
{
    float x = u_x * direction.x + u_z * direction.z;
    float squared = u_x * u_x + u_z * u_z;
    return k == 0 ? 2.0 * x
        : (k == 1 ? 3.0 * x * x - squared
                  : (k == 2 ? 2.0 * x * (2.0 * x * x - squared) : x * x * (5.0 * x * x - 3.0 * squared)));
}

specular_sum specular_with_spot(specular_sum moments, vec3 direction, float solid_angle)
{
    moments.values[0] += solid_angle;
@SPOT_LINES@
    return moments;
}

specular_sum specular_finished(specular_sum sum)
{
    sum.values[0] += 2.0 * atan(sum.turn.y, sum.turn.x);
    return sum;
}
