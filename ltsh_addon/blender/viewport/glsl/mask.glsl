void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    float depth = 1.0;
#ifdef LTSH_BRUSHING
    depth = texelFetch(tangents, texel, 0).w != 0.0 ? 1.0 : 0.75;
#endif
    gl_FragDepth = texelFetch(positions, texel, 0).w > 0.0 ? depth : 0.0;
}
