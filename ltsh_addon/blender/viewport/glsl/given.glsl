/* What a sample has of surfaces that are Cycles' alone: its own light, and in alpha what it does not cover of them.
Sums before the sample count with weight -1, those after it with 1. */
void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy);
  vec4 sum = texelFetch(picture, texel, 0);
  color = min(texelFetch(share, texel, 0).x, 1.0) * vec4(weight * sum.rgb, max(weight, 0.0) - weight * sum.a);
}
