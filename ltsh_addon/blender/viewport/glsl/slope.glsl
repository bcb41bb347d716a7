/* The term of B in the albedo of a rough diffuse surface under `cosine`: `shading.diffuse.albedo_slope`. */
float rough_slope(float cosine)
{
    float root = sqrt(max(1.0 - cosine, 0.0));
    float value = 0.0;
@SLOPE@
    return root * value;
}
