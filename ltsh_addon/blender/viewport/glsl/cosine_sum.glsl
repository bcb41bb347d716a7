/* Twice the integral of z over a polygon. */
struct specular_sum { float values[1]; };

specular_sum specular_empty()
{
    specular_sum sum;
    sum.values[0] = 0.0;
    return sum;
}

specular_sum specular_with_edge(specular_sum sum, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    sum.values[0] += edge.normal.z * edge.phi;
    return sum;
}

specular_sum specular_with_spot(specular_sum sum, vec3 direction, float solid_angle)
{
    sum.values[0] += 2.0 * solid_angle * direction.z;
    return sum;
}

specular_sum specular_finished(specular_sum sum)
{
    sum.values[0] *= 0.5 * LTSH_ONE_OVER_PI;
    return sum;
}
