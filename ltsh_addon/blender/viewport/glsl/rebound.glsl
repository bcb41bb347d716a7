/* The part of a rough diffuse lobe from light that is scattered several times: `shading.diffuse.rebound`. */
vec3 rebound_of(vec3 color, float cosine, float sigma)
{
  const float pi = 3.14159265;
  float a = 1.0 / (pi + sigma * (0.5 * pi - 2.0 / 3.0));
  float b = sigma * a;
  color = clamp(color, vec3(0.0), vec3(1.0));
  float average = pi * a + (2.0 * pi - 5.6) / 3.0 * b;
  float lost = max(1.0 - average, 1e-9);
  vec3 scattered = color * color / pi * average / lost / (1.0 - color * lost);
  return scattered * (1.0 - pi * a - b * rough_slope(cosine));
}
